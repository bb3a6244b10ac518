"""Exponential and logarithm as polynomials, so that a loop that calls them vectorises.

The wheels bring no vector mathematics, and calling ``exp`` for one sample after another takes most
of the time of expectation–maximisation. Both functions are inlined wherever they are used and state
their own fast-math: `REORDER` would undo the range reductions, and a function that states none
would inherit that of whichever caller is compiled first.
"""

# mypy: disallow-untyped-defs=False, check-untyped-defs=False
import math

from numba import types
from numba.extending import intrinsic

from misstep.compiling import njit

# Fast-math of the two functions here, and of the loops that call them.
CONTRACT = {"contract"}
REORDER = {"reassoc", "contract", "nsz", "arcp"}

# Adding 1.5·2⁵² to a small whole double leaves that whole number in the low bits of the sum.
_TO_LOW_BITS = 6755399441055744.0
_TO_LOW_BITS_PATTERN = 0x4338000000000000
_LOG2_E = 1.4426950408889634
_LN2 = 0.693147180559945309
_LN2_HIGH = 0.693147180369123816490
_LN2_LOW = 1.90821492927058770002e-10
# The bits of √½, the smallest mantissa that the series of the logarithm is asked for.
_HALF_ROOT = 0x3FE6A09E667F3BCD


@intrinsic
def _bits_of(typing_context, number):
    """Read a double as the int64 of the same bits."""

    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(types.int64))

    return types.int64(types.float64), generate


@intrinsic
def _double_of(typing_context, bits):
    """Read an int64 as the double of the same bits."""

    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(types.float64))

    return types.float64(types.int64), generate


@njit(fastmath=CONTRACT, forceinline=True)
def exp_nonpositive(z):
    """Return exp(z) of z ≤ 0 with relative error below 1e-15; below −708 it gives exp(−708).

    Cody–Waite reduction and a Taylor polynomial of degree 12.
    """
    v = max(z, -708.0)
    n = math.floor(v * _LOG2_E + 0.5)
    r = (v - n * _LN2_HIGH) - n * _LN2_LOW
    p = 1.0 / 479001600.0
    p = p * r + 1.0 / 39916800.0
    p = p * r + 1.0 / 3628800.0
    p = p * r + 1.0 / 362880.0
    p = p * r + 1.0 / 40320.0
    p = p * r + 1.0 / 5040.0
    p = p * r + 1.0 / 720.0
    p = p * r + 1.0 / 120.0
    p = p * r + 1.0 / 24.0
    p = p * r + 1.0 / 6.0
    p = p * r + 0.5
    p = p * r + 1.0
    p = p * r + 1.0
    return p * _double_of((_bits_of(n + _TO_LOW_BITS) + 1023) << 52)


@njit(fastmath=CONTRACT, forceinline=True)
def log_positive(v):
    """Return log(v) of a positive normal number with error below 1e-15, relative or absolute.

    2 artanh((m − 1)/(m + 1)) of the mantissa m from √½ to √2, by its series.
    """
    bits = _bits_of(v)
    exponent = (bits - _HALF_ROOT) >> 52
    m = _double_of(bits - (exponent << 52))
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    p = 1.0 / 19.0
    p = p * z + 1.0 / 17.0
    p = p * z + 1.0 / 15.0
    p = p * z + 1.0 / 13.0
    p = p * z + 1.0 / 11.0
    p = p * z + 1.0 / 9.0
    p = p * z + 1.0 / 7.0
    p = p * z + 1.0 / 5.0
    p = p * z + 1.0 / 3.0
    whole = _double_of(exponent + _TO_LOW_BITS_PATTERN) - _TO_LOW_BITS
    return whole * _LN2 + (2.0 * s + 2.0 * s * z * p)
