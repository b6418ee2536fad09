"""Frame rate from a rounded `Frame Time`."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation

COMMON_RATES = (24, 25, 30, 48, 50, 60, 72, 90, 100, 120, 240)
_NTSC = Decimal("1.001")


def frame_rate(text: str) -> float:
    """Return the frames per second of a `Frame Time` in seconds, which is often rounded.

    Raises:
        ValueError: not a number, or outside 0.00001 to 100000 s.
    """
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise ValueError(f"Frame Time: {text[:40]!r} is not a number") from None
    if not seconds.is_finite() or not Decimal("1e-5") <= seconds <= 100_000:
        raise ValueError(f"Frame Time: {text[:40]!r} s; expected 0.00001 to 100000")
    whole = round(1 / seconds)
    common = min(COMMON_RATES, key=lambda rate: abs(1 / Decimal(rate) - seconds))
    # The most likely rate whose frame time differs by less than the last digit written.
    digit = Decimal(1).scaleb(int(seconds.as_tuple().exponent))
    exact = (1 / seconds).quantize(Decimal("0.01"))  # such as 12.5
    rates = (
        (whole, digit / 1000),
        (common, digit),
        (exact, Decimal("1e-20")),
        (whole, digit),
        (whole / _NTSC, digit),
    )
    for rate, tolerance in rates:
        if rate and abs(1 / Decimal(rate) - seconds) < tolerance:
            return float(rate)
    # All digits of a float64: several rates may have this quotient, so take the most likely, or
    # else the one with the fewest digits.
    shorter = (float(f"{1 / seconds:.{digits}g}") for digits in range(1, 17))
    for rate in (*(float(rate) for rate, _ in rates if rate), *shorter):
        if 1 / rate == float(seconds):
            return rate
    return float(1 / seconds)
