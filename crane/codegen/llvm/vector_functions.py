"""sin, cos, exp, log and tanh of vectors in LLVM IR.

Unlike library functions, which take one value and clobber registers, these are inlined, take as
many values as a register holds, and have no branches. They are accurate to 1.5 units in the last
place. exp is infinite above 709, zero below -708; log of values that are not positive and normal
is NaN, and so are sin and cos of angles of 2^48 and more, whose resolution is 0.06 at best.
"""

import math
import struct
from collections.abc import Collection

MAX_VECTOR_WIDTH = 8  # values per call

# Minimax polynomials of FDLIBM (k_sin.c, k_cos.c) on [-pi/4, pi/4], highest power first.
_SIN = (
    1.58969099521155010221e-10, -2.50507602534068634195e-08, 2.75573137070700676789e-06,
    -1.98412698298579493134e-04, 8.33333333332248946124e-03, -1.66666666666666324348e-01,
)  # fmt: skip
_COS = (
    -1.13596475577881948265e-11, 2.08757232129817482790e-09, -2.75573143513906633035e-07,
    2.48015872894767294178e-05, -1.38888888888741095749e-03, 4.16666666666666019037e-02,
)  # fmt: skip
# Rational functions of Cephes (tanh.c, exp.c): tanh x = x + x z P/Q with z = x^2, |x| < 0.625;
# e^x = 1 + 2 x P / (Q - x P), |x| < ln(2) / 2.
_TANH_P = (-9.64399179425052238628e-1, -9.92877231001918586564e1, -1.61468768441708447952e3)
_TANH_Q = (1.0, 1.12811678491632931402e2, 2.23548839060100448583e3, 4.84406305325125486048e3)
_EXP_P = (1.26177193074810590878e-4, 3.02994407707441961300e-2, 9.99999999999999999910e-1)
_EXP_Q = (
    3.00198505138664455042e-6, 2.52448340349684104192e-3, 2.27265548208155028766e-1, 2.0,
)  # fmt: skip
# Minimax polynomial of FDLIBM (e_log.c) in s^2, s = f / (2 + f), highest power first.
_LOG = (
    1.479819860511658591e-01, 1.531383769920937332e-01, 1.818357216161805012e-01,
    2.222219843214978396e-01, 2.857142874366239149e-01, 3.999999999940941908e-01,
    6.666666666666735130e-01,
)  # fmt: skip
_LN2_PARTS = 6.93147180369123816490e-01, 1.90821492927058770002e-10  # the first has 32 bits
# Adding it rounds a float to an integer, in the lowest bits of the sum.
_ROUNDING_SHIFT = 1.5 * 2.0**52
_RIGHT_ANGLE = 0.5 * math.pi, 6.123233995736766e-17, -1.4973849048591833e-33  # to 159 bits
_LN2 = 6.93145751953125e-1, 1.42860682030941723212e-6  # the first has 21 bits


def _float_bits(value: float) -> int:
    (bits,) = struct.unpack(">Q", struct.pack(">d", value))
    return int(bits)


def format_real(value: float) -> str:
    """A number in LLVM IR."""
    return f"0x{_float_bits(value):016X}"


class _VectorFunctionWriter:
    """Writes the lines of one vector function.

    Args:
        name: Its name.
        width: Length of the vector.
    """

    def __init__(self, name: str, width: int):
        self.name, self._width, self._count = name, width, 0
        self.kind, self.integer_type = f"<{width} x double>", f"<{width} x i64>"
        self.truth_type = f"<{width} x i1>"
        self._head = f"define internal {self.kind} @{name}{width}({self.kind} %x) alwaysinline {{"
        self._lines: list[str] = []

    def emit(self, text: str) -> str:
        """Emit an instruction; returns its register."""
        self._count += 1
        self._lines.append(f"  %t{self._count} = {text}")
        return f"%t{self._count}"

    def word(self, value: str | float | int) -> str:
        """A register, or a vector of equal floats or integers."""
        if isinstance(value, str):
            return value
        number = f"double {format_real(value)}" if isinstance(value, float) else f"i64 {value}"
        return "<" + ", ".join([number] * self._width) + ">"

    def operation(self, name: str, a: str | float | int, b: str | float | int) -> str:
        """Emit arithmetic, of floats where the name begins with f, else of integers."""
        kind = self.kind if name.startswith("f") else self.integer_type
        return self.emit(f"{name} {kind} {self.word(a)}, {self.word(b)}")

    def fma(self, a: str | float, b: str | float, c: str | float) -> str:
        """Fused a b + c."""
        operands = ", ".join(f"{self.kind} {self.word(x)}" for x in (a, b, c))
        return self.emit(f"call {self.kind} @llvm.fma.v{self._width}f64({operands})")

    def polynomial(self, factors: tuple[float, ...], x: str) -> str:
        """Horner's scheme."""
        total: str | float = factors[0]
        for factor in factors[1:]:
            total = self.fma(total, x, factor)
        return self.word(total)

    def bits(self, x: str) -> str:
        """Bit patterns of floats."""
        return self.emit(f"bitcast {self.kind} {x} to {self.integer_type}")

    def from_bits(self, x: str) -> str:
        """Floats from bit patterns."""
        return self.emit(f"bitcast {self.integer_type} {x} to {self.kind}")

    def select(self, comparison: str, a: str, b: float, yes: str | float, no: str | float) -> str:
        """Elementwise selection by a comparison of a and b."""
        test = self.emit(f"fcmp {comparison} {self.kind} {a}, {self.word(b)}")
        chosen = f"{self.kind} {self.word(yes)}, {self.kind} {self.word(no)}"
        return self.emit(f"select {self.truth_type} {test}, {chosen}")

    def absolute_value(self, x: str) -> str:
        """Absolute value."""
        return self.emit(f"call {self.kind} @llvm.fabs.v{self._width}f64({self.kind} {x})")

    def round_quotient(self, x: str, divisor: float) -> tuple[str, str]:
        """Nearest integer of x / divisor: in the lowest bits of an integer, and as a float."""
        shifted = self.fma(x, 1.0 / divisor, _ROUNDING_SHIFT)
        return self.bits(shifted), self.operation("fsub", shifted, _ROUNDING_SHIFT)

    def subtract_multiple(self, x: str, multiple: str, units: tuple[float, ...]) -> str:
        """Remainder x - multiple (sum of units) with extra precision."""
        back = self.emit(f"fneg {self.kind} {multiple}")
        for unit in units:
            x = self.fma(back, unit, x)
        return x

    def exponential(self, x: str) -> str:
        """e^x for results below 2^1023."""
        power, twos = self.round_quotient(x, math.log(2.0))
        r = self.subtract_multiple(x, twos, _LN2)
        square = self.operation("fmul", r, r)
        top = self.operation("fmul", r, self.polynomial(_EXP_P, square))
        ratio = self.operation(
            "fdiv", top, self.operation("fsub", self.polynomial(_EXP_Q, square), top)
        )
        mantissa = self.fma(2.0, ratio, 1.0)
        exponent = self.operation("shl", self.operation("add", power, 1023), 52)
        return self.operation("fmul", mantissa, self.from_bits(exponent))

    def finish(self, result: str) -> str:
        """The complete function."""
        return "\n".join([self._head, *self._lines, f"  ret {self.kind} {result}", "}"])


def _write_sine_cosine(text: _VectorFunctionWriter) -> str:
    quarter, turns = text.round_quotient("%x", _RIGHT_ANGLE[0])
    r = text.subtract_multiple("%x", turns, _RIGHT_ANGLE)
    square = text.operation("fmul", r, r)
    sine = text.fma(text.operation("fmul", r, square), text.polynomial(_SIN, square), r)
    half = text.operation("fmul", square, 0.5)
    near = text.operation("fsub", 1.0, half)
    lost = text.operation("fsub", text.operation("fsub", 1.0, near), half)
    tail = text.fma(text.operation("fmul", square, square), text.polynomial(_COS, square), lost)
    cosine = text.operation("fadd", near, tail)
    if text.name == "cos":
        quarter = text.operation("add", quarter, 1)
    odd = text.emit(f"trunc {text.integer_type} {quarter} to {text.truth_type}")
    chosen = text.emit(f"select {text.truth_type} {odd}, {text.kind} {cosine}, {text.kind} {sine}")
    sign = text.operation("shl", text.operation("and", quarter, 2), 62)
    signed = text.from_bits(text.operation("xor", text.bits(chosen), sign))
    return text.select("olt", text.absolute_value("%x"), 2.0**48, signed, math.nan)


def _write_tanh(text: _VectorFunctionWriter) -> str:
    size = text.absolute_value("%x")
    square = text.operation("fmul", "%x", "%x")
    ratio = text.operation(
        "fdiv", text.polynomial(_TANH_P, square), text.polynomial(_TANH_Q, square)
    )
    small = text.fma(text.operation("fmul", size, square), ratio, size)
    # beyond 20 it is 1; NaN stays
    capped = text.select("ogt", size, 20.0, 20.0, size)
    grown = text.operation("fadd", text.exponential(text.operation("fadd", capped, capped)), 1.0)
    large = text.operation("fsub", 1.0, text.operation("fdiv", 2.0, grown))
    found = text.select("olt", size, 0.625, small, large)
    sign = text.operation("and", text.bits("%x"), -(2**63))
    return text.from_bits(text.operation("or", text.bits(found), sign))


def _write_exponential(text: _VectorFunctionWriter) -> str:
    # beyond, the power of two leaves its range; what underflows is 0
    most, least = 709.0, -708.0
    low = text.select("olt", "%x", least, least, "%x")
    inside = text.select("ogt", low, most, most, low)
    found = text.select("olt", "%x", least, 0.0, text.exponential(inside))
    return text.select("ogt", "%x", most, math.inf, found)


def _write_logarithm(text: _VectorFunctionWriter) -> str:
    """With x = 2^k (1 + f), log x = k ln 2 + f - (f^2 / 2 - s (f^2 / 2 + R(s^2)))."""
    # the power of two that leaves sqrt(1/2) <= 1 + f < sqrt(2)
    above = text.operation("sub", text.bits("%x"), _float_bits(math.sqrt(0.5)))
    power = text.operation("ashr", above, 52)
    down = text.operation("shl", power, 52)
    mantissa = text.from_bits(text.operation("sub", text.bits("%x"), down))
    f = text.operation("fsub", mantissa, 1.0)
    k = text.emit(f"sitofp {text.integer_type} {power} to {text.kind}")
    s = text.operation("fdiv", f, text.operation("fadd", f, 2.0))
    square = text.operation("fmul", s, s)
    rest = text.operation("fmul", square, text.polynomial(_LOG, square))
    half = text.operation("fmul", text.operation("fmul", f, 0.5), f)
    high, low = _LN2_PARTS
    small = text.fma(s, text.operation("fadd", half, rest), text.operation("fmul", k, low))
    found = text.fma(k, high, text.operation("fsub", f, text.operation("fsub", half, small)))
    normal = text.select("oge", "%x", 2.0**-1022, found, math.nan)
    return text.select("olt", "%x", math.inf, normal, math.nan)


_WRITERS = {
    "sin": _write_sine_cosine,
    "cos": _write_sine_cosine,
    "exp": _write_exponential,
    "log": _write_logarithm,
    "tanh": _write_tanh,
}
VECTOR_FUNCTIONS = frozenset(_WRITERS)


def define_functions(required: Collection[tuple[str, int]]) -> str:
    """Definitions of the functions @<name><width>, with names of `VECTOR_FUNCTIONS`."""
    texts = []
    for width in sorted({width for _, width in required}):
        kind = f"<{width} x double>"
        texts.append(f"declare {kind} @llvm.fma.v{width}f64({kind}, {kind}, {kind})")
        texts.append(f"declare {kind} @llvm.fabs.v{width}f64({kind})")
    for name, width in sorted(required):
        writer = _VectorFunctionWriter(name, width)
        texts.append(writer.finish(_WRITERS[name](writer)))
    return "\n".join(texts)


def call_functions(required: Collection[tuple[str, int]]) -> str:
    """Definitions of the same functions by those of a library, @sin, @cos and so on."""
    texts = []
    for name in sorted({name for name, _ in required}):
        texts.append(f"declare double @{name}(double) memory(none) nounwind willreturn")
    for name, width in sorted(required):
        writer, vector = _VectorFunctionWriter(name, width), "poison"
        for lane in range(width):
            x = writer.emit(f"extractelement {writer.kind} %x, i32 {lane}")
            found = writer.emit(f"call double @{name}(double {x})")
            lanes = f"{writer.kind} {vector}, double {found}, i32 {lane}"
            vector = writer.emit(f"insertelement {lanes}")
        texts.append(writer.finish(vector))
    return "\n".join(texts)
