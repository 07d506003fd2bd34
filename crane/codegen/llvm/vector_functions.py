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
        self._width, self._count = width, 0
        self.kind, self.integer_type = f"<{width} x double>", f"<{width} x i64>"
        self._head = f"define internal {self.kind} @{name}{width}({self.kind} %x) alwaysinline {{"
        self._lines: list[str] = []

    def emit(self, text: str) -> str:
        """Emit an instruction; returns its register."""
        self._count += 1
        self._lines.append(f"  %t{self._count} = {text}")
        return f"%t{self._count}"

    def float_constant(self, value: float) -> str:
        """A vector of equal floats."""
        return "<" + ", ".join([f"double {format_real(value)}"] * self._width) + ">"

    def integer_constant(self, value: int) -> str:
        """A vector of equal integers."""
        return "<" + ", ".join([f"i64 {value}"] * self._width) + ">"

    def float_operation(self, operation: str, a: str, b: str) -> str:
        """Emit arithmetic of floats."""
        return self.emit(f"{operation} {self.kind} {a}, {b}")

    def integer_operation(self, operation: str, a: str, b: str) -> str:
        """Emit arithmetic of integers."""
        return self.emit(f"{operation} {self.integer_type} {a}, {b}")

    def fma(self, a: str, b: str, c: str) -> str:
        """Fused a b + c."""
        float_type = self.kind
        return self.emit(
            f"call {float_type} @llvm.fma.v{self._width}f64({float_type} {a}, {float_type} {b}, "
            f"{float_type} {c})"
        )

    def polynomial(self, factors: tuple[float, ...], x: str) -> str:
        """Horner's scheme."""
        total = self.float_constant(factors[0])
        for factor in factors[1:]:
            total = self.fma(total, x, self.float_constant(factor))
        return total

    def bits(self, x: str) -> str:
        """Bit patterns of floats."""
        return self.emit(f"bitcast {self.kind} {x} to {self.integer_type}")

    def from_bits(self, x: str) -> str:
        """Floats from bit patterns."""
        return self.emit(f"bitcast {self.integer_type} {x} to {self.kind}")

    def emit_select(self, comparison: str, a: str, b: str, yes: str, no: str) -> str:
        """Elementwise selection by a comparison of a and b."""
        test = self.emit(f"fcmp {comparison} {self.kind} {a}, {b}")
        return self.emit(
            f"select <{self._width} x i1> {test}, {self.kind} {yes}, {self.kind} {no}"
        )

    def absolute_value(self, x: str) -> str:
        """Absolute value."""
        return self.emit(f"call {self.kind} @llvm.fabs.v{self._width}f64({self.kind} {x})")

    def round_quotient(self, x: str, divisor: float) -> tuple[str, str]:
        """Nearest integer of x / divisor: in the lowest bits of an integer, and as a float."""
        shifted = self.fma(
            x, self.float_constant(1.0 / divisor), self.float_constant(_ROUNDING_SHIFT)
        )
        return self.bits(shifted), self.float_operation(
            "fsub", shifted, self.float_constant(_ROUNDING_SHIFT)
        )

    def subtract_multiple(self, x: str, multiple: str, units: tuple[float, ...]) -> str:
        """Remainder x - multiple (sum of units) with extra precision."""
        back = self.emit(f"fneg {self.kind} {multiple}")
        for unit in units:
            x = self.fma(back, self.float_constant(unit), x)
        return x

    def exponential(self, x: str) -> str:
        """e^x for results below 2^1023."""
        power, twos = self.round_quotient(x, math.log(2.0))
        r = self.subtract_multiple(x, twos, _LN2)
        square = self.float_operation("fmul", r, r)
        top = self.float_operation("fmul", r, self.polynomial(_EXP_P, square))
        ratio = self.float_operation(
            "fdiv", top, self.float_operation("fsub", self.polynomial(_EXP_Q, square), top)
        )
        mantissa = self.fma(self.float_constant(2.0), ratio, self.float_constant(1.0))
        exponent = self.integer_operation("add", power, self.integer_constant(1023))
        scale = self.from_bits(self.integer_operation("shl", exponent, self.integer_constant(52)))
        return self.float_operation("fmul", mantissa, scale)

    def finish(self, result: str) -> str:
        """The complete function."""
        return "\n".join(
            [
                self._head,
                *self._lines,
                f"  ret {self.kind} {result}",
                "}",
            ]
        )


def _define_sine_cosine(name: str, width: int) -> str:
    text = _VectorFunctionWriter(name, width)
    quarter, turns = text.round_quotient("%x", _RIGHT_ANGLE[0])
    r = text.subtract_multiple("%x", turns, _RIGHT_ANGLE)
    square = text.float_operation("fmul", r, r)
    sine = text.fma(text.float_operation("fmul", r, square), text.polynomial(_SIN, square), r)
    half = text.float_operation("fmul", square, text.float_constant(0.5))
    near = text.float_operation("fsub", text.float_constant(1.0), half)
    lost = text.float_operation(
        "fsub", text.float_operation("fsub", text.float_constant(1.0), near), half
    )
    tail = text.fma(
        text.float_operation("fmul", square, square), text.polynomial(_COS, square), lost
    )
    cosine = text.float_operation("fadd", near, tail)
    if name == "cos":
        quarter = text.integer_operation("add", quarter, text.integer_constant(1))
    odd = text.emit(f"trunc {text.integer_type} {quarter} to <{width} x i1>")
    chosen = text.emit(f"select <{width} x i1> {odd}, {text.kind} {cosine}, {text.kind} {sine}")
    second = text.integer_operation("and", quarter, text.integer_constant(2))
    sign = text.integer_operation("shl", second, text.integer_constant(62))
    signed = text.from_bits(text.integer_operation("xor", text.bits(chosen), sign))
    far = text.float_constant(math.nan)
    return text.finish(
        text.emit_select(
            "olt", text.absolute_value("%x"), text.float_constant(2.0**48), signed, far
        )
    )


def _define_tanh(name: str, width: int) -> str:
    text = _VectorFunctionWriter(name, width)
    size = text.absolute_value("%x")
    square = text.float_operation("fmul", "%x", "%x")
    ratio = text.float_operation(
        "fdiv", text.polynomial(_TANH_P, square), text.polynomial(_TANH_Q, square)
    )
    small = text.fma(text.float_operation("fmul", size, square), ratio, size)
    # beyond 20 it is 1; NaN stays
    capped = text.emit_select(
        "ogt", size, text.float_constant(20.0), text.float_constant(20.0), size
    )
    grown = text.float_operation(
        "fadd",
        text.exponential(text.float_operation("fadd", capped, capped)),
        text.float_constant(1.0),
    )
    large = text.float_operation(
        "fsub",
        text.float_constant(1.0),
        text.float_operation("fdiv", text.float_constant(2.0), grown),
    )
    found = text.emit_select("olt", size, text.float_constant(0.625), small, large)
    sign = text.integer_operation("and", text.bits("%x"), text.integer_constant(-(2**63)))
    return text.finish(text.from_bits(text.integer_operation("or", text.bits(found), sign)))


def _define_exponential(name: str, width: int) -> str:
    text = _VectorFunctionWriter(name, width)
    # beyond, the power of two leaves its range; what underflows is 0
    most, least = text.float_constant(709.0), text.float_constant(-708.0)
    low = text.emit_select("olt", "%x", least, least, "%x")
    inside = text.emit_select("ogt", low, most, most, low)
    found = text.emit_select(
        "olt", "%x", least, text.float_constant(0.0), text.exponential(inside)
    )
    return text.finish(text.emit_select("ogt", "%x", most, text.float_constant(math.inf), found))


def _define_logarithm(name: str, width: int) -> str:
    """With x = 2^k (1 + f), log x = k ln 2 + f - (f^2 / 2 - s (f^2 / 2 + R(s^2)))."""
    text = _VectorFunctionWriter(name, width)
    # the power of two that leaves sqrt(1/2) <= 1 + f < sqrt(2)
    above = text.integer_operation(
        "sub", text.bits("%x"), text.integer_constant(_float_bits(math.sqrt(0.5)))
    )
    power = text.integer_operation("ashr", above, text.integer_constant(52))
    down = text.integer_operation("shl", power, text.integer_constant(52))
    mantissa = text.from_bits(text.integer_operation("sub", text.bits("%x"), down))
    f = text.float_operation("fsub", mantissa, text.float_constant(1.0))
    k = text.emit(f"sitofp {text.integer_type} {power} to {text.kind}")
    s = text.float_operation("fdiv", f, text.float_operation("fadd", f, text.float_constant(2.0)))
    square = text.float_operation("fmul", s, s)
    rest = text.float_operation("fmul", square, text.polynomial(_LOG, square))
    half = text.float_operation(
        "fmul", text.float_operation("fmul", f, text.float_constant(0.5)), f
    )
    high, low = (text.float_constant(part) for part in _LN2_PARTS)
    small = text.fma(
        s, text.float_operation("fadd", half, rest), text.float_operation("fmul", k, low)
    )
    found = text.fma(
        k, high, text.float_operation("fsub", f, text.float_operation("fsub", half, small))
    )
    normal = text.emit_select(
        "oge", "%x", text.float_constant(2.0**-1022), found, text.float_constant(math.nan)
    )
    return text.finish(
        text.emit_select(
            "olt", "%x", text.float_constant(math.inf), normal, text.float_constant(math.nan)
        )
    )


_DEFINITIONS = {
    "sin": _define_sine_cosine,
    "cos": _define_sine_cosine,
    "exp": _define_exponential,
    "log": _define_logarithm,
    "tanh": _define_tanh,
}
VECTOR_FUNCTIONS = frozenset(_DEFINITIONS)


def define_functions(required: Collection[tuple[str, int]]) -> str:
    """Definitions of the functions @<name><width>, with names of `VECTOR_FUNCTIONS`."""
    texts = []
    for width in sorted({width for _, width in required}):
        kind = f"<{width} x double>"
        texts.append(f"declare {kind} @llvm.fma.v{width}f64({kind}, {kind}, {kind})")
        texts.append(f"declare {kind} @llvm.fabs.v{width}f64({kind})")
    return "\n".join(
        [*texts, *(_DEFINITIONS[name](name, width) for name, width in sorted(required))]
    )
