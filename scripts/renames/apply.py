"""Rename what the tables beside this file list, by pyright's semantic rename.

python scripts/renames/apply.py TREE [FIRST LAST]
"""

import ast
import json
import subprocess
import sys
import urllib.parse
from pathlib import Path

HERE = Path(__file__).parent
PARTS = ("crane", "tests", "scripts", "examples")


class LanguageServer:
    """pyright's language server over pipes."""

    def __init__(self, root):
        self.process = subprocess.Popen(
            ["pyright-langserver", "--stdio"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=root,
        )  # fmt: skip
        self.count = 0
        folder = {"uri": root.as_uri(), "name": "tree"}
        changes = {"workspaceEdit": {"documentChanges": True}, "configuration": True}
        self.request(
            "initialize",
            {"processId": None, "rootUri": root.as_uri(), "workspaceFolders": [folder],
             "capabilities": {"workspace": {**changes, "workspaceFolders": True}}},
        )  # fmt: skip
        self.notify("initialized", {})
        for path in (x for part in PARTS for x in sorted((root / part).rglob("*.py"))):
            document = {"uri": path.as_uri(), "languageId": "python", "version": 1}
            opened = {"textDocument": {**document, "text": path.read_text()}}
            self.notify("textDocument/didOpen", opened)

    def send(self, message):
        """Write a message."""
        body = json.dumps({"jsonrpc": "2.0", **message}).encode()
        self.process.stdin.write(b"Content-Length: %d\r\n\r\n" % len(body) + body)
        self.process.stdin.flush()

    def receive(self):
        """Read a message."""
        length = 0
        while line := self.process.stdout.readline().strip():
            if line.lower().startswith(b"content-length"):
                length = int(line.split(b":")[1])
        return json.loads(self.process.stdout.read(length))

    def notify(self, method, params):
        """Send what has no answer."""
        self.send({"method": method, "params": params})

    def request(self, method, params):
        """The answer to a request; questions of the server meanwhile get empty ones."""
        self.count += 1
        self.send({"id": self.count, "method": method, "params": params})
        while True:
            answer = self.receive()
            if "method" in answer and "id" in answer:  # a question of the server's
                items = answer.get("params", {}).get("items", ())
                self.send({"id": answer["id"], "result": [{} for _ in items]})
            elif answer.get("id") == self.count:
                return answer.get("result")


def definition(tree, qualified):
    """Line and column (bytes, from 0) of a name in the tables' form.

    Raises:
        KeyError: There is none.
    """
    path, _, parameter = qualified.rstrip(")").partition("(")
    path, _, local = path.partition("/")
    node = tree
    for name in path.split("."):
        scope, node = node, None
        kinds = ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
        defined = [x for x in ast.walk(scope) if isinstance(x, kinds) and x.name == name]
        if defined:
            node = next((x for x in defined if x in getattr(scope, "body", ())), defined[0])
            continue
        for x in ast.walk(scope):
            if isinstance(x, ast.Name) and x.id == name and isinstance(x.ctx, ast.Store):
                return x.lineno - 1, x.col_offset
        for x in ast.walk(scope):
            if isinstance(x, ast.Attribute) and x.attr == name and isinstance(x.ctx, ast.Store):
                return x.end_lineno - 1, x.end_col_offset - len(name)
        raise KeyError(qualified)
    if parameter:
        if isinstance(node, ast.ClassDef):
            node = next(x for x in node.body if getattr(x, "name", "") == "__init__")
        return next(
            (x.lineno - 1, x.col_offset) for x in ast.walk(node.args)
            if isinstance(x, ast.arg) and x.arg == parameter
        )  # fmt: skip
    for x in ast.walk(node) if local else ():
        if isinstance(x, ast.FunctionDef) and x.name == local:
            return x.lineno - 1, x.col_offset + len("def ")
        if isinstance(x, ast.Name) and x.id == local and isinstance(x.ctx, ast.Store):
            return x.lineno - 1, x.col_offset
    if local:
        raise KeyError(qualified)
    keyword = {ast.ClassDef: "class ", ast.FunctionDef: "def "}.get(type(node), "async def ")
    return node.lineno - 1, node.col_offset + len(keyword)


def edits_of(root, rows):
    """Edits by file, {path: {(line, start, end): text}}, and what could not be found."""
    server, edits, problems = LanguageServer(root), {}, []
    for count, (path, qualified, new) in enumerate(rows):
        try:
            source = (root / path).read_text()
            line, column = definition(ast.parse(source), qualified)
        except (KeyError, OSError, StopIteration):
            problems.append(f"not found: {path} {qualified}")
            continue
        column = len(source.splitlines()[line].encode()[:column].decode())
        place = {"line": line, "character": column + 1}
        params = {"textDocument": {"uri": (root / path).as_uri()}, "position": place}
        found = server.request("textDocument/rename", {**params, "newName": new}) or {}
        for change in found.get("documentChanges", ()):
            file = urllib.parse.unquote(change["textDocument"]["uri"]).removeprefix("file://")
            for edit in change["edits"]:
                start, end = edit["range"]["start"], edit["range"]["end"]
                key = start["line"], start["character"], end["character"]
                was = edits.setdefault(file, {}).setdefault(key, edit["newText"])
                if was != edit["newText"]:
                    problems.append(f"clash: {file}:{key[0] + 1} {was} and {edit['newText']}")
        if count % 100 == 0:
            print(count, len(rows), flush=True)
    return edits, problems


def apply(edits):
    """Put the edits into the files, from the end."""
    for file, places in edits.items():
        lines = Path(file).read_text().splitlines(keepends=True)
        for (line, start, end), text in sorted(places.items(), reverse=True):
            units = lines[line].encode("utf-16-le")
            units = units[: 2 * start] + text.encode("utf-16-le") + units[2 * end :]
            lines[line] = units.decode("utf-16-le")
        Path(file).write_text("".join(lines))


def main():
    """Ask for all places, then apply them."""
    root = Path(sys.argv[1]).resolve()
    rows = [line.split() for line in (HERE / "names.txt").read_text().splitlines() if line]
    first, last = (int(x) for x in sys.argv[2:4]) if len(sys.argv) > 3 else (0, len(rows))
    edits, problems = edits_of(root, rows[first:last])
    apply(edits)
    print("\n".join(problems))


if __name__ == "__main__":
    main()
