"""Counts what regular expressions do: steps of a backtracking matcher, the same on every machine.

Our own matcher matches the expressions again and must find what Python's finds. It tries alternatives in the same
order, so its steps per character are the same up to a factor.
"""

from __future__ import annotations

import contextlib
import re
import re._constants as op  # type: ignore[import-not-found]
import re._parser as parser  # type: ignore[import-not-found]
import sys
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from biresnerf.errors import InputError

Then = Callable[[int], int | None]
_FUNCTIONS = ("search", "match", "fullmatch", "findall", "finditer", "split", "sub", "subn")
_CATEGORIES = {
    op.CATEGORY_DIGIT: r"\d", op.CATEGORY_NOT_DIGIT: r"\D", op.CATEGORY_SPACE: r"\s",
    op.CATEGORY_NOT_SPACE: r"\S", op.CATEGORY_WORD: r"\w", op.CATEGORY_NOT_WORD: r"\W",
}  # fmt: skip
_ONE_CHARACTER = {op.LITERAL, op.NOT_LITERAL, op.IN, op.ANY}


class _Matcher:
    """One expression on one text; `steps` counts, and it fails when they are more than ``most``."""

    def __init__(self, pattern: re.Pattern[Any], text: str | bytes, most: int) -> None:
        self._flags, self.steps, self._most = pattern.flags, 0, most
        self._tree = parser.parse(pattern.pattern, pattern.flags & ~re.DEBUG)
        self._text = text if isinstance(text, str) else text.decode("latin-1")
        self._ascii = isinstance(text, bytes) or bool(self._flags & re.ASCII)
        self._known: dict[tuple[int, str], bool] = {}

    def spans(self, function: str) -> list[tuple[int, int]]:
        """What Python's matcher would find, too."""
        size, found, at = len(self._text), [], 0
        empty = -1  # where an empty match was: there is no second one
        while at <= size:

            def then(end: int, begin: int = at, empty: int = empty) -> int | None:
                return None if (function == "fullmatch" and end != size) or end == begin == empty else end

            end = self._sequence(self._tree, 0, at, then)
            if end is not None:
                found.append((at, end))
            if function in {"match", "fullmatch"} or (found and function == "search"):
                break
            empty, at = (end, end) if end == at else (empty, at + 1 if end is None else end)
        return found

    def _sequence(self, items: Any, first: int, at: int, then: Then) -> int | None:
        for index in range(first, len(items)):
            self.steps += 1
            assert self.steps <= self._most, "too many steps"
            kind, value = items[index]
            if kind in _ONE_CHARACTER:
                if not self._is(items[index], at):
                    return None
                at += 1
            elif kind is op.AT:
                if not self._stands(value, at):
                    return None
            elif kind in {op.ASSERT, op.ASSERT_NOT}:
                direction, inner = value
                begin = at if direction > 0 else at - inner.getwidth()[0]
                met = begin >= 0 and self._sequence(inner, 0, begin, lambda end: end) is not None
                if met == (kind is op.ASSERT_NOT):
                    return None
            else:
                return self._branching(
                    kind, value, at, lambda end, index=index: self._sequence(items, index + 1, end, then)
                )
        return then(at)

    def _branching(self, kind: Any, value: Any, at: int, rest: Then) -> int | None:
        if kind is op.SUBPATTERN:
            return self._sequence(value[3], 0, at, rest)
        if kind is op.BRANCH:
            for branch in value[1]:
                if (end := self._sequence(branch, 0, at, rest)) is not None:
                    return end
            return None
        if kind not in {op.MAX_REPEAT, op.MIN_REPEAT}:
            raise NotImplementedError(kind)
        least, most, inner = value
        if len(inner) == 1 and inner[0][0] in _ONE_CHARACTER:
            return self._run(inner[0], least, most, at, rest, greedy=kind is op.MAX_REPEAT)
        greedy = kind is op.MAX_REPEAT

        def again(count: int, at: int) -> int | None:
            def one_more() -> int | None:
                if count >= most:
                    return None
                return self._sequence(
                    inner, 0, at, lambda end: None if end == at and count >= least else again(count + 1, end)
                )

            if count < least:
                return one_more()
            if greedy:
                return end if (end := one_more()) is not None else rest(at)
            return end if (end := rest(at)) is not None else one_more()

        return again(0, at)

    def _run(self, node: Any, least: int, most: int, at: int, rest: Then, *, greedy: bool) -> int | None:
        if not greedy:
            for count in range(most + 1):
                if count >= least and (end := rest(at + count)) is not None:
                    return end
                self.steps += 1
                if not self._is(node, at + count):
                    return None
        longest = 0
        while longest < most and self._is(node, at + longest):
            longest += 1
        self.steps += longest
        for count in range(longest, least - 1, -1):
            if (end := rest(at + count)) is not None:
                return end
        return None

    def _is(self, node: Any, at: int) -> bool:
        if at >= len(self._text):
            return False
        key = id(node[1]) if node[0] is op.IN else hash(node), self._text[at]
        if key not in self._known:
            self._known[key] = self._looked_up(node, self._text[at])
        return self._known[key]

    def _looked_up(self, node: Any, character: str) -> bool:
        kind, value = node
        same = {character.lower(), character.upper()} if self._flags & re.IGNORECASE else {character}
        if kind is op.ANY:
            return bool(self._flags & re.DOTALL) or character != "\n"
        if kind is op.LITERAL:
            return chr(value) in same
        if kind is op.NOT_LITERAL:
            return chr(value) not in same
        if kind is op.RANGE:
            return any(value[0] <= ord(one) <= value[1] for one in same)
        if kind is op.CATEGORY:
            return re.match(_CATEGORIES[value], character, re.ASCII if self._ascii else 0) is not None
        negated = value[0][0] is op.NEGATE
        return any(self._looked_up(one, character) for one in value[negated:]) != negated

    def _stands(self, place: Any, at: int) -> bool:
        text = self._text
        lines = bool(self._flags & re.MULTILINE)
        if place in {op.AT_BEGINNING, op.AT_BEGINNING_STRING}:
            return at == 0 or (place is op.AT_BEGINNING and lines and text[at - 1] == "\n")
        if place in {op.AT_END, op.AT_END_STRING}:
            last = at == len(text) or (place is op.AT_END and text[at:] == "\n")
            return last or (place is op.AT_END and lines and text[at] == "\n")
        word = [0 <= i < len(text) and (text[i].isalnum() or text[i] == "_") for i in (at - 1, at)]
        return (word[0] != word[1]) == (place is op.AT_BOUNDARY)


@contextlib.contextmanager
def _deep() -> Iterator[None]:
    """Repeats of groups are calls within calls."""
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(10**6)
    try:
        yield
    finally:
        sys.setrecursionlimit(limit)


class Steps:
    """`taken` so far, at most `most`."""

    def __init__(self) -> None:
        self.taken, self.most = 0, sys.maxsize

    def assert_grow_as_size(self, read: Callable[[int], object], size: int, most: float = 8) -> None:
        """Reading four times as much as ``size`` takes at most so many times as many steps: 16, if by its square."""
        with contextlib.suppress(InputError):
            read(size)
        assert self.taken > 50, "the expression sees the text"
        self.taken, self.most = 0, int(most * self.taken)
        with contextlib.suppress(InputError):
            read(4 * size)

    def of(self, pattern: re.Pattern[Any], function: str, text: Any) -> None:
        """Count those of one call."""
        matcher = _Matcher(pattern, text, self.most - self.taken)
        with _deep():
            found = matcher.spans(function)
        once = getattr(pattern, function)(text) if function in {"search", "match", "fullmatch"} else None
        real = (
            pattern.finditer(text)
            if function not in {"search", "match", "fullmatch"}
            else [once]
            if once
            else []
        )
        assert found == [match.span() for match in real], (pattern.pattern, text[:100])
        self.taken += matcher.steps


class _Counted:
    """A compiled expression whose steps are counted."""

    def __init__(self, pattern: re.Pattern[Any], steps: Steps) -> None:
        self._pattern, self._steps = pattern, steps

    def __getattr__(self, name: str) -> Any:
        own = getattr(self._pattern, name)
        if name not in _FUNCTIONS:
            return own

        def counted(*arguments: Any) -> Any:
            self._steps.of(self._pattern, name, arguments[name in {"sub", "subn"}])
            return own(*arguments)

        return counted


def counted_steps(monkeypatch: pytest.MonkeyPatch) -> Steps:
    """Of all expressions that readers of data use from now on."""
    steps = Steps()

    def counted(pattern: Any, flags: int = 0) -> Any:
        return _Counted(re.compile(pattern, flags), steps)

    def function(name: str) -> Callable[..., Any]:
        takes = 2 if name in {"sub", "subn"} else 1
        return lambda pattern, *given: getattr(counted(pattern, *given[takes:]), name)(*given[:takes])

    spy = SimpleNamespace(**{**vars(re), "compile": counted, **{name: function(name) for name in _FUNCTIONS}})
    for name, module in list(sys.modules.items()):
        if name.startswith("biresnerf.data."):
            for key, value in list(vars(module).items()):
                if value is re:
                    monkeypatch.setattr(module, key, spy)
                elif isinstance(value, re.Pattern):
                    monkeypatch.setattr(module, key, _Counted(value, steps))
    return steps
