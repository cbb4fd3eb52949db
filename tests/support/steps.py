"""What a call told of its progress."""

from __future__ import annotations


class Steps(list):
    """Notes (done, total, what) of each call."""

    def __call__(self, done: float, total: float, what: str = "") -> None:
        self.append((done, total, what))

    def count(self, first: int = 1, last: int | None = None) -> None:
        """One call after another, from `first` to `last`; by default to the total."""
        (total,) = {total for _, total, _ in self}
        assert [done for done, _, _ in self] == list(range(first, (total if last is None else last) + 1))
        assert len({what for _, _, what in self}) == 1
