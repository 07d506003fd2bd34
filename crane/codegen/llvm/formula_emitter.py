"""Formulas in LLVM IR; long ones are split into pieces.

Compile time grows faster than the length of a function, so that a long formula becomes several
functions, called one after another, which exchange values in memory. Dot products of one vector
with several are computed by one vector instruction per element: long formulas are limited by the
instruction cache of the processor, about 32 kB, and a vector instruction is as long as a scalar
one.
"""

from collections.abc import Iterable, Sequence
from typing import Any

from crane.codegen.linked_functions import LinkedFunction
from crane.codegen.llvm.vector_functions import MAX_VECTOR_WIDTH, VECTOR_FUNCTIONS, format_real
from crane.codegen.symbolic import Scalar, SymbolicExpression
from crane.codegen.vector_layout import Formula, assign_memory_slots, operand_indices

# Allows fused multiply-add; reordering sums would gain nothing and could cancel NaN.
FAST_MATH_FLAGS = "nsz arcp contract"
Operands = Sequence[float | int]


def format_operand(operand: float | int) -> str:
    """A number, or the register of an operation."""
    return f"%v{operand}" if isinstance(operand, int) else format_real(operand)


def emit_dot_products(
    indices: Sequence[int], operands: Sequence[Operands], known_vectors: set[str]
) -> list[str]:
    """Lines that compute `%d` and the first index, and each dot product as a scalar.

    Args:
        indices: Indices of the dot operations.
        operands: Operands of each.
        known_vectors: Names of vectors that exist; new ones are added.
    """
    kind, half, name = _vector_type(len(indices)), len(operands[0]) // 2, f"%d{indices[0]}"
    lines: list[str] = []
    total = ""
    for i in range(half):
        factor = _emit_vector([operands[0][i]] * len(indices), known_vectors, lines)
        other = _emit_vector([each[half + i] for each in operands], known_vectors, lines)
        made = name if half == 1 else f"{name}_{i}"
        lines.append(f"  {made} = fmul {FAST_MATH_FLAGS} {kind} {factor}, {other}")
        if i:
            before, made = made, name if i == half - 1 else f"{name}_{i}_"
            lines.append(f"  {made} = fadd {FAST_MATH_FLAGS} {kind} {total}, {before}")
        total = made
    lines += [
        f"  %v{index} = extractelement {kind} {name}, i32 {lane}"
        for lane, index in enumerate(indices)
    ]
    return lines


def emit_dot_product_stores(
    indices: Sequence[int], output_lanes: Iterable[tuple[int, int]]
) -> list[str]:
    """Lines that store dot products to the outputs, adjacent ones together.

    Args:
        indices: Indices of the dot operations.
        output_lanes: Index of an output, and the lane of its dot product.
    """
    lines: list[str] = []
    runs: list[list[tuple[int, int]]] = []
    for at, lane in sorted(output_lanes):
        if runs and runs[-1][-1] == (at - 1, lane - 1):
            runs[-1].append((at, lane))
        else:
            runs.append([(at, lane)])
    for run in runs:
        at, kind, short = run[0][0], _vector_type(len(indices)), _vector_type(len(run))
        lanes = ", ".join(f"i32 {lane}" for _, lane in run)
        lines += [
            f"  %s{at} = shufflevector {kind} %d{indices[0]}, {kind} poison, "
            f"<{len(run)} x i32> <{lanes}>",
            f"  %q{at} = getelementptr double, ptr %out, i64 {at}",
            f"  store {short} %s{at}, ptr %q{at}, align 8",
        ]
    return lines


def _emit_vector(operands: Operands, known_vectors: set[str], lines: list[str]) -> str:
    """The name of a vector of scalars; appends the lines that create it if it is new."""
    kind, words = _vector_type(len(operands)), [format_operand(x) for x in operands]
    same = len(set(words)) == 1
    name = "%w" + "_".join(word.removeprefix("%") for word in words)
    if name in known_vectors:
        return name
    known_vectors.add(name)
    vector = "poison"
    for lane, word in enumerate(words[:1] if same else words):
        made = name if lane == len(words) - 1 else f"{name}.{lane}"
        lines.append(f"  {made} = insertelement {kind} {vector}, double {word}, i32 {lane}")
        vector = made
    if vector != name:
        lines.append(
            f"  {name} = shufflevector {kind} {vector}, {kind} poison, "
            f"<{len(words)} x i32> zeroinitializer"
        )
    return name


def _vector_type(count: int) -> str:
    return f"<{count} x double>"


# operations up to which a formula stays one function, which runs faster
MAX_SINGLE_FUNCTION_LENGTH = 6500
PIECE_LENGTH = 1000  # operations of a piece
_ARITHMETIC = {"add": "fadd", "subtract": "fsub", "multiply": "fmul", "divide": "fdiv"}
_INTRINSICS = {
    "sqrt": "@llvm.sqrt.f64", "abs": "@llvm.fabs.f64", "maximum": "@larger",
    "copysign": "@llvm.copysign.f64", "positive": "@chosen",
}  # fmt: skip
# Spilled registers take one byte less per access through the frame pointer, which matters for
# formulas larger than the instruction cache (about 32 kB).
_FRAME_POINTER_ATTRIBUTES = '"frame-pointer"="all" "no-realign-stack"'
_VECTORIZED = VECTOR_FUNCTIONS | {"dot"}
_FUNCTION_END = "  ret void\n}"


def emit_formula(
    formula: Formula, functions: set[tuple[str, int]], linked: LinkedFunction | None = None
) -> str:
    """A formula as a function, or an internal one that is linked with others.

    Adds the vector functions that it calls to `functions`.
    """
    name, inputs = formula.name, [f"in{i}" for i in range(formula.input_count)]
    if linked is not None:
        name, inputs = linked.name, [*linked.arguments[:-1]]
    operations = formula.operations
    steps = _group_operations(operations, formula)
    # pieces of about equal length; a short formula is a single piece
    count = round(len(steps) / PIECE_LENGTH) if len(steps) > MAX_SINGLE_FUNCTION_LENGTH else 1
    size = max(1, -(-len(steps) // count))
    pieces = [
        _FormulaPiece(operations, steps[start : start + size])
        for start in range(0, max(1, len(steps)), size)
    ]
    memory_slots = assign_memory_slots([piece.computed for piece in pieces], operations)
    targets: dict[int, list[int]] = {}
    copied_outputs: list[list[str]] = []
    for i, value in enumerate(formula.outputs):
        if isinstance(value, SymbolicExpression) and operations[value.index][0] != "load":
            targets.setdefault(value.index, []).append(i)
        else:
            copied_outputs.append(_emit_copied_output(i, value, operations))
    texts = [piece.emit(memory_slots, targets, functions) for piece in pieces]
    for start in range(0, len(copied_outputs), PIECE_LENGTH):
        texts.append(
            [line for lines in copied_outputs[start : start + PIECE_LENGTH] for line in lines]
        )
    if len(pieces) == 1 and len(copied_outputs) <= PIECE_LENGTH:
        texts = [[line for text in texts for line in text]]
    arguments = ", ".join([*(f"ptr noalias readonly %{x}" for x in inputs), "ptr noalias %out"])
    head = f"define {'internal ' if linked else ''}void @{name}({arguments}) "
    if len(texts) <= 1:
        head += f"{_FRAME_POINTER_ATTRIBUTES} {{"
        return "\n".join([head, *(line for text in texts for line in text), _FUNCTION_END])
    shared = f"{arguments}, ptr noalias %between"
    words = ", ".join([*(f"ptr %{x}" for x in inputs), "ptr %out, ptr %between"])
    between = f"  %between = alloca [{1 + max(memory_slots.values(), default=0)} x double]"
    definitions, calls = [], [f"{head}{{", between]
    for number, text in enumerate(texts):
        head = f"define internal void @{name}.{number}({shared}) noinline {{"
        definitions += [head, *text, _FUNCTION_END]
        calls.append(f"  call void @{name}.{number}({words})")
    return "\n".join([*definitions, *calls, _FUNCTION_END])


def _group_operations(operations: Sequence[tuple], formula: Formula) -> list[list[int]]:
    """Operations in an order of computation, those of `_VECTORIZED` in groups."""
    # by the largest number of `_VECTORIZED` operations on a path to them
    level_of: dict[int, int] = {}
    levels: list[list[int]] = []
    for index in formula.order:
        operation = operations[index]
        before = max((level_of.get(x, 0) for x in operand_indices(operation)), default=0)
        level_of[index] = before + (operation[0] in _VECTORIZED)
        while len(levels) <= level_of[index]:
            levels.append([])
        levels[level_of[index]].append(index)
    steps: list[list[int]] = []
    for level in levels:
        same: dict[tuple, list[int]] = {}
        for i in level:
            if operations[i][0] in _VECTORIZED:
                # dot products with one first vector are computed together
                shared = len(operations[i]) // 2 if operations[i][0] == "dot" else 0
                same.setdefault(operations[i][: 1 + shared], []).append(i)
        for _, indices in sorted(same.items(), key=lambda item: item[0][0]):
            steps += [
                indices[start : start + MAX_VECTOR_WIDTH]
                for start in range(0, len(indices), MAX_VECTOR_WIDTH)
            ]
        steps += [[i] for i in level if operations[i][0] not in _VECTORIZED]
    return steps


class _FormulaPiece:
    """Consecutive operations of a formula.

    Args:
        operations: All operations of the formula.
        steps: Groups of operations of the piece, in their order.

    Attributes:
        computed: Indices of its operations.
    """

    def __init__(self, operations: Sequence[tuple], steps: list[list[int]]):
        self._operations, self._steps = operations, steps
        self.computed = {index for step in steps for index in step}

    def emit(
        self,
        memory_slots: dict[int, int],
        output_indices: dict[int, list[int]],
        functions: set[tuple[str, int]],
    ) -> list[str]:
        """The lines of the piece.

        Args:
            memory_slots: Memory slots of values that pieces exchange.
            output_indices: Indices of the outputs that an operation computes.
            functions: Receives the vector functions that are called.
        """
        lines, available = [], set(self.computed)
        vectors: set[str] = set()
        for step in self._steps:
            for x in sorted(
                {x for index in step for x in operand_indices(self._operations[index])}
            ):
                if x not in available:
                    available.add(x)
                    lines += self._emit_load(x, memory_slots)
            if self._operations[step[0]][0] == "dot":
                lines += emit_dot_products(step, [self._operations[i][1:] for i in step], vectors)
                lines += emit_dot_product_stores(
                    step, ((at, k) for k, i in enumerate(step) for at in output_indices.get(i, ()))
                )
            else:
                lines += self._emit_step(step, functions)
                for index in step:
                    for at in output_indices.get(index, ()):
                        lines += _emit_store(f"q{at}", "out", at, f"%v{index}")
            for index in step:
                if index in memory_slots:
                    lines += _emit_store(f"b{index}", "between", memory_slots[index], f"%v{index}")
        return lines

    def _emit_step(self, step: list[int], functions: set[tuple[str, int]]) -> list[str]:
        name = self._operations[step[0]][0]
        if name not in VECTOR_FUNCTIONS:
            return [_emit_scalar_operation(step[0], *self._operations[step[0]])]
        width = 1 << (len(step) - 1).bit_length()
        functions.add((name, width))
        return _emit_vector_call(name, width, [(i, self._operations[i][1]) for i in step])

    def _emit_load(self, index: int, memory_slots: dict[int, int]) -> list[str]:
        """Load a value from an argument of the formula or from an earlier piece."""
        kind, *where = self._operations[index]
        array, at = (
            (f"in{where[0]}", where[1]) if kind == "load" else ("between", memory_slots[index])
        )
        return [
            f"  %p{index} = getelementptr double, ptr %{array}, i64 {at}",
            f"  %v{index} = load double, ptr %p{index}",
        ]


def _emit_copied_output(at: int, value: Scalar, operations: Sequence[tuple]) -> list[str]:
    """An output that is a constant or an argument."""
    if not isinstance(value, SymbolicExpression):
        return _emit_store(f"q{at}", "out", at, format_real(float(value)))
    _, array, index = operations[value.index]
    return [
        f"  %l{at} = getelementptr double, ptr %in{array}, i64 {index}",
        f"  %c{at} = load double, ptr %l{at}",
        *_emit_store(f"q{at}", "out", at, f"%c{at}"),
    ]


def _emit_store(name: str, array: str, at: int, word: str) -> list[str]:
    return [
        f"  %{name} = getelementptr double, ptr %{array}, i64 {at}",
        f"  store double {word}, ptr %{name}",
    ]


def _emit_vector_call(name: str, width: int, calls: list[tuple[int, Any]]) -> list[str]:
    """One call of a function of `width` values, the last of which may be unused."""
    lines = []
    kind, vector = f"<{width} x double>", "poison"
    for lane in range(width):  # unused lanes repeat the first value
        _, operand = calls[lane] if lane < len(calls) else calls[0]
        word, made = format_operand(operand), f"%{name}{calls[0][0]}_{lane}"
        lines.append(f"  {made} = insertelement {kind} {vector}, double {word}, i32 {lane}")
        vector = made
    result = f"%{name}{calls[0][0]}"
    lines.append(f"  {result} = call {kind} @{name}{width}({kind} {vector})")
    lines += [
        f"  %v{index} = extractelement {kind} {result}, i32 {lane}"
        for lane, (index, _) in enumerate(calls)
    ]
    return lines


def _emit_scalar_operation(index: int, kind: str, *operands: Any) -> str:
    words = [format_operand(operand) for operand in operands]
    if kind == "negate":
        return f"  %v{index} = fneg double {words[0]}"
    if kind in _INTRINSICS:
        typed = ", ".join(f"double {word}" for word in words)
        return f"  %v{index} = call double {_INTRINSICS[kind]}({typed})"
    return f"  %v{index} = {_ARITHMETIC[kind]} {FAST_MATH_FLAGS} double {words[0]}, {words[1]}"
