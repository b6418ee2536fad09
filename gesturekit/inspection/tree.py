"""Text drawing of a skeleton as a tree, one line per limb, with body parts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from gesturekit.motion.skeleton import Skeleton

_BELOW = " > "


def tree(skeleton: Skeleton, labels: Mapping[str, str], width: int) -> list[str]:
    """Return the lines of the tree: each joint follows its parent, parts are in brackets.

    End joints come last on their line, and the fingers of a hand share one line.

    Args:
        skeleton: the rig.
        labels: {joint name: part} of `gesturekit.motion.parts.part_labels`; empty if parts cannot
            be identified.
        width: columns to use.
    """
    return list(_Drawing(skeleton, labels, width).lines())


@dataclass(frozen=True)
class _Drawing:
    skeleton: Skeleton
    labels: Mapping[str, str]
    width: int

    def lines(self) -> Iterator[str]:
        waiting = [(0, "", "")]  # a joint, what stands before it, and before what hangs on it
        while waiting:
            joint, first, rest = waiting.pop()
            chain, ends, forks = self._limb(joint)
            pieces = list(self._labelled(chain))
            if ends:
                pieces[-1] += f" + {', '.join(self.skeleton.names[j] for j in ends)} [end]"
            yield from self._wrapped(pieces, _BELOW, first, rest + "   ")
            if forks and self._is_hand(chain[-1]):
                yield from self._fingers(chain[-1], forks, rest)
                continue
            for child in reversed(forks):
                marks = ("└─ ", "   ") if child == forks[-1] else ("├─ ", "│  ")
                waiting.append((child, rest + marks[0], rest + marks[1]))

    def _limb(self, joint: int) -> tuple[list[int], list[int], list[int]]:
        """Return the chain from a joint, the end joints beside it, and the joints it forks into."""
        chain, ends = [joint], list[int]()
        while True:
            children = list(self.skeleton.children(chain[-1]))
            marks = [j for j in children if self._is_mark(j)] if len(children) > 1 else []
            others = [j for j in children if j not in marks]
            if len(others) > 1 and self._is_hand(chain[-1]):
                return chain, ends, others
            ends += marks
            if len(others) != 1:
                return chain, ends, others
            chain += others

    def _is_mark(self, joint: int) -> bool:
        is_end = self.labels.get(self.skeleton.names[joint]) == "end"
        return is_end and self.skeleton.is_leaf(joint)

    def _is_hand(self, joint: int) -> bool:
        """Return True if all descendants of a joint are fingers."""
        below = self.skeleton.descendants(joint)
        return all(self.labels.get(self.skeleton.names[j]) in ("finger", "end") for j in below)

    def _fingers(self, hand: int, heads: Sequence[int], rest: str) -> Iterator[str]:
        words = f"{len(self.skeleton.descendants(hand))} joints of fingers: "
        words += ", ".join(self.skeleton.names[j] for j in heads)
        yield from self._wrapped(words.split(" "), " ", f"{rest}└─ ", f"{rest}      ")

    def _labelled(self, chain: Sequence[int]) -> Iterator[str]:
        """Yield the names of a chain, with a label after neighbours of the same part."""
        names = [self.skeleton.names[joint] for joint in chain]
        for name, below in zip(names, [*names[1:], None]):
            label = self.labels.get(name)
            is_last = below is None or self.labels.get(below) != label
            yield name + (f" [{label}]" if is_last and label and label != "other" else "")

    def _wrapped(self, pieces: Sequence[str], glue: str, first: str, rest: str) -> Iterator[str]:
        line = first + pieces[0]
        for piece in pieces[1:]:
            if len(line) + len(glue) + len(piece) > self.width:
                yield line
                line = rest.rstrip() + glue.rjust(len(rest) - len(rest.rstrip())) + piece
            else:
                line += glue + piece
        yield line
