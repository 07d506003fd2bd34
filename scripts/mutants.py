"""Random single faults in the modules that compute, and which of them the fast tests notice.

Each fault changes an operator or a constant in a copy of the repository, where the tests that
execute its statement run, shortest first, until one fails. A run that was interrupted continues.
"""

import argparse
import hashlib
import json
import math
import os
import random
import re
import shlex
import shutil
import subprocess
import sys
import time
from bisect import bisect
from collections import Counter
from concurrent.futures import ThreadPoolExecutor, as_completed
from itertools import accumulate, islice
from pathlib import Path
from queue import Queue

import pytest
from attrs import evolve
from cosmic_ray.ast import ast_nodes, get_ast_from_path
from cosmic_ray.mutating import mutate_and_test
from cosmic_ray.plugins import get_operator, operator_names
from cosmic_ray.work_item import MutationSpec
from coverage import Coverage

ROOT = Path(__file__).parents[1]
OTHER_ROOMS = {"common", "formats", "view", "cli"}
FAULTS = re.compile(
    "core/(NumberReplacer|Replace(True|False|And|Or)With.*|ReplaceUnaryOperator_Delete_(USub|Not)"
    "|ReplaceBinaryOperator_(Add_Sub|Sub_Add|Mul_Div|Div_Mul|FloorDiv_Mul|Mod_Mul|Pow_Mul"
    "|BitAnd_BitOr)|ReplaceComparisonOperator_(Lt_LtE|Lt_GtE|LtE_Lt|LtE_Gt|Gt_GtE|Gt_LtE|GtE_Gt"
    "|GtE_Lt|Eq_NotEq|NotEq_Eq|Is_IsNot|IsNot_Is))"
)
# before the end of a change, in its line: a check of lengths, stars that do not multiply
NO_FAULT = re.compile(r"(strict=True|[,({]\s*\*+)$")
MAX_DURATION = 60.0  # [s] of the tests of one fault, as they were recorded
FIRST = 16  # tests that run before the others
TIME_LIMIT = 900.0  # [s]
PROCESSES = 2


class Recorder:
    """Plugin of pytest: durations and executed lines of all tests and shared fixtures."""

    def __init__(self):
        self.contexts, self.durations, self.running = {}, Counter(), ""
        self.coverage = Coverage("lines", data_suffix=True, source=["crane"], config_file=False)
        self.coverage.start()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):  # noqa: D102
        fixtures = [defined[-1] for defined in item._fixtureinfo.name2fixturedefs.values()]
        self.running = item.nodeid
        self.contexts[item.nodeid] = [item.nodeid, *map(fixture_name, fixtures)]
        self.coverage.switch_context(item.nodeid)
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef):  # noqa: D102
        if fixturedef.scope == "function":
            return (yield)
        self.coverage.switch_context(fixture_name(fixturedef))
        start = time.monotonic()
        try:
            return (yield)
        finally:
            duration = time.monotonic() - start
            self.durations[fixture_name(fixturedef)] = duration
            self.durations[self.running] -= duration  # which the report of the test includes
            self.coverage.switch_context(self.running)

    def pytest_runtest_logreport(self, report):  # noqa: D102
        if report.nodeid in self.contexts:  # not where tests are only distributed
            self.durations[report.nodeid] += math.inf if report.failed else report.duration

    def pytest_sessionfinish(self):  # noqa: D102
        self.coverage.stop()
        self.coverage.save()
        recorded = json.dumps([self.contexts, self.durations])
        Path(f"tests-{os.getpid()}.json").write_text(recorded)


def fixture_name(fixture):
    """The name of a fixture among those of tests."""
    return f"{fixture.baseid} {fixture.argname}"


def pytest_load_initial_conftests(early_config):
    """Record from before the package is imported."""
    early_config.pluginmanager.register(Recorder())


def shell_command(copy, *options):
    """A line for the shell that runs tests in a copy of the repository."""
    path = ":".join([str(copy), f"{copy}/scripts", os.environ.get("PYTHONPATH", "")])
    python = f"PYTHONDONTWRITEBYTECODE= PYTHONPATH={path} exec {sys.executable}"
    return f"cd {copy} && {python} -m pytest -q -p no:cacheprovider {' '.join(options)}"


def record_tests(place):
    """Record what the fast tests execute: `lines` of coverage, `tests.json` with durations."""
    copy = copy_repository(place / "copy-0")
    (place / "nothing").touch(0o600)  # a file for a folder: no program comes from the cache
    line = shell_command(copy, f"-n {PROCESSES}", "-p mutants")
    subprocess.run(line, shell=True, env=os.environ | {"XDG_CACHE_HOME": f"{place}/nothing"})
    tests = {}
    for part in copy.glob("tests-*.json"):
        contexts, durations = json.loads(part.read_text())
        for name, used in contexts.items():
            tests[name] = sum(durations.get(x, 0.0) for x in used), used
    Coverage(f"{place}/lines", config_file=False).combine([str(copy)])
    (place / "tests.json").write_text(json.dumps(tests))


def copy_repository(copy):
    """Copy the repository, without what other programs have made in it."""
    shutil.rmtree(copy, ignore_errors=True)
    ignored = shutil.ignore_patterns(".git", ".venv", ".*_cache", "build", "dist", "__pycache__")
    return Path(shutil.copytree(ROOT, copy, ignore=ignored))


def draw_faults(seed):
    """All operators and constants in random order, each with a random change of it."""
    names = [name for name in operator_names() if FAULTS.fullmatch(name)]
    operators = {name: get_operator(name)() for name in names}
    places = []
    for path in sorted((ROOT / "crane").rglob("*.py")):
        counts, lines = Counter(), path.read_text().splitlines()
        changed = path.relative_to(ROOT).parts[1] not in OTHER_ROOMS
        for node in ast_nodes(get_ast_from_path(path)) if changed else ():
            changes = []
            for name, operator in operators.items():
                for start, end in operator.mutation_positions(node):
                    if not NO_FAULT.search(lines[end[0] - 1][: end[1]]):
                        changes.append(MutationSpec(path, name, counts[name], start, end))
                    counts[name] += 1
            places += [changes] if changes else []
    generator = random.Random(seed)
    generator.shuffle(places)
    return map(generator.choice, places)


def select_tests(executed, tests, path, line):
    """Whether a statement is executed, and the tests that do so, shortest first.

    If it is executed only on import, or in other processes, those of its module.
    """
    contexts = executed.get_data().contexts_by_lineno(path)
    statements = [*executed.analysis2(path)[1], math.inf]
    k = bisect(statements, line)
    own = {x for n in contexts if statements[k - 1] <= n < statements[k] for x in contexts[n]}
    used = own - {""} or {x for names in contexts.values() for x in names} - {""}
    if own and not used:  # constants, which any test may need
        used = set(tests)
    found = [name for name, (_, names) in tests.items() if not used.isdisjoint(names)]
    found.sort(key=lambda name: tests[name][0])
    durations = accumulate(tests[name][0] for name in found)
    return bool(own), found[: bisect([*durations], MAX_DURATION)]


def judge(copy, fault, is_executed, names):
    """What the tests with these names find of a fault in a copy."""
    path = fault.module_path.relative_to(ROOT)
    # programs are not kept while a file has just been written: each test would build its own
    line = "sleep 3"
    # most faults are noticed before the modules of all tests are collected
    for file, part in {"first.txt": names[:FIRST], "others.txt": names[FIRST:]}.items():
        (copy / file).write_text("\n".join(part))
        line += f" && ({shell_command(copy, '-x', f'@{file}')})" if part else ""
    result = mutate_and_test(
        [evolve(fault, module_path=copy / path)], shlex.join(["sh", "-c", line]), TIME_LIMIT
    )
    verdict = "killed" if result.is_killed else "survived" if is_executed else "not covered"
    return {
        "place": f"{path}:{fault.start_pos[0]}",
        "verdict": "timed out" if result.output == "timeout" else verdict,
        "tests": len(names),
        "difference": [x for x in result.diff.splitlines() if re.match(r"[-+](?![-+]{2} )", x)],
        "output": result.output[-1000:],
    }


def main():
    """Judge faults that have not been judged, and print what became of all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--number", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    sources = sorted(p for folder in ("crane", "tests") for p in (ROOT / folder).rglob("*.py"))
    digest = hashlib.sha256(b"".join(p.read_bytes() for p in sources)).hexdigest()[:12]
    place = ROOT / "build" / "mutants" / digest
    if not (place / "tests.json").exists():
        record_tests(place)
    tests = json.loads((place / "tests.json").read_text())
    executed = Coverage(f"{place}/lines", config_file=False)
    executed.load()
    copies = Queue()
    for number in range(PROCESSES):
        copies.put(copy_repository(place / f"copy-{number}"))
    os.environ["XDG_CACHE_HOME"] = f"{place}/cache"
    results = place / f"seed-{options.seed}.json"
    found = json.loads(results.read_text()) if results.exists() else {}
    chosen = {}
    for k, fault in enumerate(islice(draw_faults(options.seed), options.number)):
        path = place / "copy-0" / fault.module_path.relative_to(ROOT)
        chosen[str(k)] = fault, *select_tests(executed, tests, str(path), fault.start_pos[0])

    def judge_next(key):
        copy = copies.get()
        try:
            return judge(copy, *chosen[key])
        finally:
            copies.put(copy)

    with ThreadPoolExecutor(PROCESSES) as executor:
        futures = {executor.submit(judge_next, key): key for key in chosen if key not in found}
        for future in as_completed(futures):
            found[futures[future]] = future.result()
            results.write_text(json.dumps(found, indent=1))
            print("{place}: {verdict}".format(**future.result()), flush=True)
    judged = [found[key] for key in chosen]
    counts = Counter(x["verdict"] for x in judged)
    for verdict in ("killed", "survived", "timed out", "not covered"):
        print(f"{verdict:12}{counts[verdict]:4}")
    for x in judged:
        if x["verdict"] in ("survived", "not covered"):
            print("\n{place}: {verdict}, {tests} tests".format(**x), *x["difference"], sep="\n")


if __name__ == "__main__":
    main()
