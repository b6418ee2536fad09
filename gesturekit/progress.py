"""Progress of long tasks: a bar on a terminal, otherwise a plain line every few seconds."""

from __future__ import annotations

from typing import Any

from tqdm import tqdm

SECONDS_BETWEEN_LINES = 10.0

_LINE = "{percentage:3.0f}%, {n_fmt} of {total_fmt} {unit}, {elapsed} passed, {remaining} left"
_LINE_WITHOUT_TOTAL = "{n_fmt} {unit}, {elapsed} passed"


class Progress(tqdm):
    """A tqdm bar that prints whole lines outside a terminal, for log files.

    Takes tqdm's arguments. On a terminal the bar disappears when it is done, unless `leave` is
    set. Elsewhere a line with count and remaining time is printed every `SECONDS_BETWEEN_LINES`;
    shorter tasks print nothing.
    """

    def __init__(self, *args: Any, leave: bool = False, **options: Any) -> None:
        super().__init__(*args, leave=leave, delay=1e-3, **options)
        self._in_place = self.disable or self.fp.isatty()
        if not self._in_place:
            line = _LINE if self.total is not None else _LINE_WITHOUT_TOTAL
            self.bar_format = f"{'{desc}: ' if self.desc else ''}{line}{{postfix}}"
            self._next_line = self.start_t + SECONDS_BETWEEN_LINES

    @property
    def format_dict(self) -> dict[str, Any]:
        """Fields of the progress line; outside a terminal, the unit is pluralised."""
        values = super().format_dict
        number = self.n if self.total is None else self.total
        if not self._in_place and number != 1:
            values["unit"] += "s"
        return values

    def display(self, msg: str | None = None, pos: int | None = None) -> bool:
        """Draw the bar; outside a terminal, print a line if it is time for one."""
        if self._in_place:
            return super().display(msg, pos)
        if msg is None and self._time() >= self._next_line:
            self._next_line = self._time() + SECONDS_BETWEEN_LINES
            self.fp.write(f"{str(self).strip()}\n")
            self.fp.flush()
        return False

    def clear(self, nolock: bool = False) -> None:
        """Clear the bar before a message; outside a terminal, do nothing."""
        if self._in_place:
            super().clear(nolock)


def time_in_words(seconds: float) -> str:
    """Return a duration such as 0.4 s, 12 s, 1 min 5 s or 2 h 3 min."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
