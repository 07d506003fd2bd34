"""Straight formulas in LLVM's language, long ones in pieces.

What takes a compiler time grows faster than a function's length; so a long formula becomes several
functions, one called after the other, that hand each other numbers in memory.
"""

from collections.abc import Sequence
from typing import Any

from crane.codegen.llvm.dots import FAST, common, dots_text, operand_word, stored_dots
from crane.codegen.llvm.functions import VECTOR, WIDEST, real
from crane.codegen.representation import Formula
from crane.codegen.scalar import Expression, Number, needed

WHOLE = 6500  # operations of a formula that stays one function, which runs faster
PIECE = 1000  # of one of several
_ARITHMETIC = {"add": "fadd", "subtract": "fsub", "multiply": "fmul", "divide": "fdiv"}
_CALLS = {
    "sqrt": "@llvm.sqrt.f64", "abs": "@llvm.fabs.f64", "maximum": "@larger",
    "copysign": "@llvm.copysign.f64", "positive": "@chosen",
}  # fmt: skip
# Numbers that registers have no room for are reached with a byte less through the frame pointer.
# A processor keeps some 32 kB of instructions at hand, and waits for those of longer formulas.
_SHORT = '"frame-pointer"="all" "no-realign-stack"'
_AT_ONCE = VECTOR | {"dot"}
_END = "  ret void\n}"


def formula_text(formula: Formula, functions: set[tuple[str, int]]) -> str:
    """A straight function; adds to `functions` what it calls of `definitions`."""
    tapes = {value.tape for value in formula.outputs if isinstance(value, Expression)}
    operations = tapes.pop().operations if tapes else []
    pieces = [_Piece(operations, steps) for steps in _cut(_steps(operations, formula))]
    places = _places(pieces)
    targets: dict[int, list[int]] = {}
    copied: list[list[str]] = []
    for i, value in enumerate(formula.outputs):
        if isinstance(value, Expression) and operations[value.index][0] != "load":
            targets.setdefault(value.index, []).append(i)
        else:
            copied.append(_copied(i, value, operations))
    texts = [piece.lines(places, targets, functions) for piece in pieces]
    for start in range(0, len(copied), PIECE):
        texts.append([line for lines in copied[start : start + PIECE] for line in lines])
    if len(pieces) == 1 and len(copied) <= PIECE:
        texts = [[line for text in texts for line in text]]
    inputs = [f"ptr noalias readonly %in{i}" for i in range(formula.arrays)]
    arguments = ", ".join([*inputs, "ptr noalias %out"])
    head = f"define void @{formula.name}({arguments}) "
    if len(texts) <= 1:
        head += f"{_SHORT} {{"
        return "\n".join([head, *(line for text in texts for line in text), _END])
    shared = f"{arguments}, ptr noalias %between"
    out, lines = (
        [],
        [f"{head}{{", f"  %between = alloca [{1 + max(places.values(), default=0)} x double]"],
    )
    for number, text in enumerate(texts):
        name = f"@{formula.name}.{number}"
        out.append("\n".join([f"define internal void {name}({shared}) noinline {{", *text, _END]))
        words = [f"ptr %in{i}" for i in range(formula.arrays)]
        lines.append(f"  call void {name}({', '.join([*words, 'ptr %out, ptr %between'])})")
    return "\n".join([*out, *lines, _END])


def _steps(operations: Sequence[tuple], formula: Formula) -> list[list[int]]:
    """Operations in an order that can be computed, those of `_AT_ONCE` several at once."""
    steps: list[list[int]] = []
    for level in _levels(operations, needed(formula.outputs)):
        same: dict[tuple, list[int]] = {}
        for i in level:
            if operations[i][0] in _AT_ONCE:
                name = operations[i][:1]
                alike = common(operations[i]) if name == ("dot",) else name
                same.setdefault(alike, []).append(i)
        for _, indices in sorted(same.items(), key=lambda item: item[0][0]):
            steps += [indices[start : start + WIDEST] for start in range(0, len(indices), WIDEST)]
        steps += [[i] for i in level if operations[i][0] not in _AT_ONCE | {"load"}]
    return steps


def _cut(steps: list[list[int]]) -> list[list[list[int]]]:
    """Pieces of about equal length; a short formula stays whole, and one without steps is one."""
    count = round(len(steps) / PIECE) if len(steps) > WHOLE else 1
    size = -(-len(steps) // count) if steps else 1
    return [steps[start : start + size] for start in range(0, max(1, len(steps)), size)]


class _Piece:
    """Consecutive operations of a formula.

    Args:
        operations: All of the formula.
        steps: Those of the piece, in their order.

    Attributes:
        made: What it computes.
        used: What it needs of earlier pieces.
    """

    def __init__(self, operations: Sequence[tuple], steps: list[list[int]]):
        self._operations, self._steps = operations, steps
        self.made = {index for step in steps for index in step}
        self.used = {
            x
            for index in self.made
            for x in _operands(operations[index])
            if x not in self.made and operations[x][0] != "load"
        }

    def lines(
        self,
        places: dict[int, int],
        targets: dict[int, list[int]],
        functions: set[tuple[str, int]],
    ) -> list[str]:
        """Its statements.

        Args:
            places: Where in memory pieces find each other's numbers.
            targets: Which outputs a number is.
            functions: Takes what it calls of `definitions`.
        """
        lines, known = [], set(self.made)
        vectors: set[str] = set()
        for step in self._steps:
            for x in sorted({x for index in step for x in _operands(self._operations[index])}):
                if x not in known:
                    known.add(x)
                    lines += self._read(x, places)
            if self._operations[step[0]][0] == "dot":
                lines += dots_text(step, [self._operations[i][1:] for i in step], vectors)
                lanes = ((at, k) for k, i in enumerate(step) for at in targets.get(i, ()))
                lines += stored_dots(step, lanes)
            else:
                lines += self._step(step, functions)
                for index in step:
                    for at in targets.get(index, ()):
                        lines += _stored(f"q{at}", "out", at, f"%v{index}")
            for index in step:
                if index in places:
                    lines += _stored(f"b{index}", "between", places[index], f"%v{index}")
        return lines

    def _step(self, step: list[int], functions: set[tuple[str, int]]) -> list[str]:
        name = self._operations[step[0]][0]
        if name not in VECTOR:
            return [_single(step[0], *self._operations[step[0]])]
        width = 1 << (len(step) - 1).bit_length()
        functions.add((name, width))
        return _call_at_once(name, width, [(i, self._operations[i][1]) for i in step])

    def _read(self, index: int, places: dict[int, int]) -> list[str]:
        """A number from an argument of the formula or an earlier piece."""
        kind, *where = self._operations[index]
        array, at = (f"in{where[0]}", where[1]) if kind == "load" else ("between", places[index])
        return [
            f"  %p{index} = getelementptr double, ptr %{array}, i64 {at}",
            f"  %v{index} = load double, ptr %p{index}",
        ]


def _copied(at: int, value: Number, operations: Sequence[tuple]) -> list[str]:
    """An output that nothing has to be computed for."""
    if not isinstance(value, Expression):
        return _stored(f"q{at}", "out", at, real(float(value)))
    _, array, index = operations[value.index]
    return [
        f"  %l{at} = getelementptr double, ptr %in{array}, i64 {index}",
        f"  %c{at} = load double, ptr %l{at}",
        *_stored(f"q{at}", "out", at, f"%c{at}"),
    ]


def _stored(name: str, array: str, at: int, word: str) -> list[str]:
    return [
        f"  %{name} = getelementptr double, ptr %{array}, i64 {at}",
        f"  store double {word}, ptr %{name}",
    ]


def _operands(operation: tuple) -> list[int]:
    if operation[0] == "load":
        return []
    return [x for x in operation[1:] if isinstance(x, int)]


def _places(pieces: Sequence[_Piece]) -> dict[int, int]:
    """Memory for what later pieces need, used again behind the last one that does."""
    last = {index: number for number, piece in enumerate(pieces) for index in piece.used}
    places: dict[int, int] = {}
    free: list[int] = []
    count = 0
    for number, piece in enumerate(pieces):
        for index in sorted(piece.made & last.keys()):
            if not free:
                free, count = [count], count + 1
            places[index] = free.pop()
        free += sorted(places[index] for index in piece.used if last[index] == number)
    return places


def _levels(operations: Sequence[tuple], indices: Sequence[int]) -> list[list[int]]:
    """Operations by how many of `_AT_ONCE` come after each other on the way to them."""
    level: dict[int, int] = {}
    out: list[list[int]] = []
    for index in indices:
        operation = operations[index]
        before = max((level[x] for x in _operands(operation)), default=0)
        level[index] = before + (operation[0] in _AT_ONCE)
        while len(out) <= level[index]:
            out.append([])
        out[level[index]].append(index)
    return out


def _call_at_once(name: str, width: int, calls: list[tuple[int, Any]]) -> list[str]:
    """One call of a function of `width` numbers, of which there may be fewer."""
    lines = []
    kind, vector = f"<{width} x double>", "poison"
    for lane in range(width):  # the first once more where there are too few
        _, operand = calls[lane] if lane < len(calls) else calls[0]
        word, made = operand_word(operand), f"%{name}{calls[0][0]}_{lane}"
        lines.append(f"  {made} = insertelement {kind} {vector}, double {word}, i32 {lane}")
        vector = made
    result = f"%{name}{calls[0][0]}"
    lines.append(f"  {result} = call {kind} @{name}{width}({kind} {vector})")
    lines += [
        f"  %v{index} = extractelement {kind} {result}, i32 {lane}"
        for lane, (index, _) in enumerate(calls)
    ]
    return lines


def _single(index: int, kind: str, *operands: Any) -> str:
    """One operation of one number."""
    words = [operand_word(operand) for operand in operands]
    if kind == "negate":
        return f"  %v{index} = fneg double {words[0]}"
    if kind in _CALLS:
        typed = ", ".join(f"double {word}" for word in words)
        return f"  %v{index} = call double {_CALLS[kind]}({typed})"
    return f"  %v{index} = {_ARITHMETIC[kind]} {FAST} double {words[0]}, {words[1]}"
