"""sin, cos, exp, log and tanh of several numbers at once, in LLVM's language.

A library's functions take one number each and keep no register alive; these are inlined, take as
many numbers as a register holds, and have no branches. They are correct to 1.5 units in the last
place. exp beyond 709 is infinite, below -708 zero; log of what is not positive and normal is NaN,
and so are sin and cos of angles of 2^48 and more, which doubles know to 0.06 at best.
"""

import math
import struct
from collections.abc import Collection

WIDEST = 8  # numbers at once

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
# A sum with it has the other term, rounded to an integer, in its last bits.
_INTEGER = 1.5 * 2.0**52
_RIGHT_ANGLE = 0.5 * math.pi, 6.123233995736766e-17, -1.4973849048591833e-33  # to 159 bits
_LN2 = 6.93145751953125e-1, 1.42860682030941723212e-6  # the first has 21 bits


def _bits(value: float) -> int:
    (bits,) = struct.unpack(">Q", struct.pack(">d", value))
    return int(bits)


def real(value: float) -> str:
    """A number in LLVM's language."""
    return f"0x{_bits(value):016X}"


class _Text:
    """Lines of one function of a vector.

    Args:
        name: Its name.
        width: Length of the vector.
    """

    def __init__(self, name: str, width: int):
        self._width, self._count = width, 0
        self.kind, self.whole = f"<{width} x double>", f"<{width} x i64>"
        self._head = f"define internal {self.kind} @{name}{width}({self.kind} %x) alwaysinline {{"
        self._lines: list[str] = []

    def line(self, text: str) -> str:
        """A new value."""
        self._count += 1
        self._lines.append(f"  %t{self._count} = {text}")
        return f"%t{self._count}"

    def number(self, value: float) -> str:
        """The same number everywhere."""
        return "<" + ", ".join([f"double {real(value)}"] * self._width) + ">"

    def integer(self, value: int) -> str:
        """The same integer everywhere."""
        return "<" + ", ".join([f"i64 {value}"] * self._width) + ">"

    def do(self, operation: str, a: str, b: str) -> str:
        """Arithmetic of numbers."""
        return self.line(f"{operation} {self.kind} {a}, {b}")

    def on_bits(self, operation: str, a: str, b: str) -> str:
        """Arithmetic of integers."""
        return self.line(f"{operation} {self.whole} {a}, {b}")

    def fma(self, a: str, b: str, c: str) -> str:
        """Fused a b + c."""
        kind = self.kind
        return self.line(
            f"call {kind} @llvm.fma.v{self._width}f64({kind} {a}, {kind} {b}, {kind} {c})"
        )

    def polynomial(self, factors: tuple[float, ...], x: str) -> str:
        """Horner's scheme."""
        total = self.number(factors[0])
        for factor in factors[1:]:
            total = self.fma(total, x, self.number(factor))
        return total

    def bits(self, x: str) -> str:
        """A number's bits."""
        return self.line(f"bitcast {self.kind} {x} to {self.whole}")

    def from_bits(self, x: str) -> str:
        """The number of these bits."""
        return self.line(f"bitcast {self.whole} {x} to {self.kind}")

    def where(self, comparison: str, a: str, b: str, yes: str, no: str) -> str:
        """One of two, number by number."""
        test = self.line(f"fcmp {comparison} {self.kind} {a}, {b}")
        return self.line(
            f"select <{self._width} x i1> {test}, {self.kind} {yes}, {self.kind} {no}"
        )

    def size(self, x: str) -> str:
        """Absolute value."""
        return self.line(f"call {self.kind} @llvm.fabs.v{self._width}f64({self.kind} {x})")

    def rounded(self, x: str, per: float) -> tuple[str, str]:
        """Nearest integer of x / per: bits that end with it, and as a number."""
        shifted = self.fma(x, self.number(1.0 / per), self.number(_INTEGER))
        return self.bits(shifted), self.do("fsub", shifted, self.number(_INTEGER))

    def less(self, x: str, times: str, units: tuple[float, ...]) -> str:
        """Rest of x - times (sum of units), hardly rounded."""
        back = self.line(f"fneg {self.kind} {times}")
        for unit in units:
            x = self.fma(back, self.number(unit), x)
        return x

    def exponential(self, x: str) -> str:
        """e^x where 2^1023 is out of reach."""
        power, twos = self.rounded(x, math.log(2.0))
        r = self.less(x, twos, _LN2)
        square = self.do("fmul", r, r)
        top = self.do("fmul", r, self.polynomial(_EXP_P, square))
        ratio = self.do("fdiv", top, self.do("fsub", self.polynomial(_EXP_Q, square), top))
        mantissa = self.fma(self.number(2.0), ratio, self.number(1.0))
        exponent = self.on_bits("add", power, self.integer(1023))
        scale = self.from_bits(self.on_bits("shl", exponent, self.integer(52)))
        return self.do("fmul", mantissa, scale)

    def end(self, result: str) -> str:
        """The whole function."""
        return "\n".join(
            [
                self._head,
                *self._lines,
                f"  ret {self.kind} {result}",
                "}",
            ]
        )


def _circular(name: str, width: int) -> str:
    text = _Text(name, width)
    quarter, turns = text.rounded("%x", _RIGHT_ANGLE[0])
    r = text.less("%x", turns, _RIGHT_ANGLE)
    square = text.do("fmul", r, r)
    sine = text.fma(text.do("fmul", r, square), text.polynomial(_SIN, square), r)
    half = text.do("fmul", square, text.number(0.5))
    near = text.do("fsub", text.number(1.0), half)
    lost = text.do("fsub", text.do("fsub", text.number(1.0), near), half)
    tail = text.fma(text.do("fmul", square, square), text.polynomial(_COS, square), lost)
    cosine = text.do("fadd", near, tail)
    if name == "cos":
        quarter = text.on_bits("add", quarter, text.integer(1))
    odd = text.line(f"trunc {text.whole} {quarter} to <{width} x i1>")
    chosen = text.line(f"select <{width} x i1> {odd}, {text.kind} {cosine}, {text.kind} {sine}")
    second = text.on_bits("and", quarter, text.integer(2))
    sign = text.on_bits("shl", second, text.integer(62))
    signed = text.from_bits(text.on_bits("xor", text.bits(chosen), sign))
    far = text.number(math.nan)
    return text.end(text.where("olt", text.size("%x"), text.number(2.0**48), signed, far))


def _hyperbolic(name: str, width: int) -> str:
    text = _Text(name, width)
    size = text.size("%x")
    square = text.do("fmul", "%x", "%x")
    ratio = text.do("fdiv", text.polynomial(_TANH_P, square), text.polynomial(_TANH_Q, square))
    small = text.fma(text.do("fmul", size, square), ratio, size)
    # beyond 20 it is 1; NaN stays
    capped = text.where("ogt", size, text.number(20.0), text.number(20.0), size)
    grown = text.do("fadd", text.exponential(text.do("fadd", capped, capped)), text.number(1.0))
    large = text.do("fsub", text.number(1.0), text.do("fdiv", text.number(2.0), grown))
    found = text.where("olt", size, text.number(0.625), small, large)
    sign = text.on_bits("and", text.bits("%x"), text.integer(-(2**63)))
    return text.end(text.from_bits(text.on_bits("or", text.bits(found), sign)))


def _exponential(name: str, width: int) -> str:
    text = _Text(name, width)
    # beyond, the power of two leaves its range; what underflows is 0
    most, least = text.number(709.0), text.number(-708.0)
    low = text.where("olt", "%x", least, least, "%x")
    inside = text.where("ogt", low, most, most, low)
    found = text.where("olt", "%x", least, text.number(0.0), text.exponential(inside))
    return text.end(text.where("ogt", "%x", most, text.number(math.inf), found))


def _logarithm(name: str, width: int) -> str:
    """With x = 2^k (1 + f), log x = k ln 2 + f - (f^2 / 2 - s (f^2 / 2 + R(s^2)))."""
    text = _Text(name, width)
    # the power of two that leaves sqrt(1/2) <= 1 + f < sqrt(2)
    above = text.on_bits("sub", text.bits("%x"), text.integer(_bits(math.sqrt(0.5))))
    power = text.on_bits("ashr", above, text.integer(52))
    down = text.on_bits("shl", power, text.integer(52))
    mantissa = text.from_bits(text.on_bits("sub", text.bits("%x"), down))
    f = text.do("fsub", mantissa, text.number(1.0))
    k = text.line(f"sitofp {text.whole} {power} to {text.kind}")
    s = text.do("fdiv", f, text.do("fadd", f, text.number(2.0)))
    square = text.do("fmul", s, s)
    rest = text.do("fmul", square, text.polynomial(_LOG, square))
    half = text.do("fmul", text.do("fmul", f, text.number(0.5)), f)
    high, low = (text.number(part) for part in _LN2_PARTS)
    small = text.fma(s, text.do("fadd", half, rest), text.do("fmul", k, low))
    found = text.fma(k, high, text.do("fsub", f, text.do("fsub", half, small)))
    normal = text.where("oge", "%x", text.number(2.0**-1022), found, text.number(math.nan))
    return text.end(text.where("olt", "%x", text.number(math.inf), normal, text.number(math.nan)))


_MAKERS = {
    "sin": _circular,
    "cos": _circular,
    "exp": _exponential,
    "log": _logarithm,
    "tanh": _hyperbolic,
}
VECTOR = frozenset(_MAKERS)


def definitions(wanted: Collection[tuple[str, int]]) -> str:
    """The functions @<name><width>, each one of `VECTOR` of so many numbers."""
    texts = []
    for width in sorted({width for _, width in wanted}):
        kind = f"<{width} x double>"
        texts.append(f"declare {kind} @llvm.fma.v{width}f64({kind}, {kind}, {kind})")
        texts.append(f"declare {kind} @llvm.fabs.v{width}f64({kind})")
    return "\n".join([*texts, *(_MAKERS[name](name, width) for name, width in sorted(wanted))])
