"""A memory for results that are asked for again and again."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

T = TypeVar("T")


class Memory(Generic[T]):
    """Results by key; those that were not asked for the longest are forgotten."""

    def __init__(self, most: int, size: Callable[[T], int] = lambda _: 1):
        """An empty one.

        Args:
            most: total size of what is kept; the last result is, whatever its size.
            size: of a result.
        """
        self._most, self._size, self._total = most, size, 0
        self._results: OrderedDict[Hashable, T] = OrderedDict()

    def __contains__(self, key: Hashable) -> bool:
        return key in self._results

    def __getitem__(self, key: Hashable) -> T:
        self._results.move_to_end(key)
        return self._results[key]

    def __setitem__(self, key: Hashable, result: T) -> None:
        self._results[key] = result
        self._total += self._size(result)
        while self._total > self._most and len(self._results) > 1:
            _, forgotten = self._results.popitem(last=False)
            self._total -= self._size(forgotten)

    def or_made(self, key: Hashable, make: Callable[[], T]) -> T:
        """The result of this key, made if it is not there."""
        if key not in self._results:
            result = make()
            self[key] = result
            return result
        return self[key]
