"""Parse formulas of linear models such as ``shape ~ log(size) + sex * age``; no code is evaluated.

A term is the name of a column, ``log(name)`` or ``factor(name)``, or an interaction of up to three of these, joined by
``:``. ``a * b`` means ``a + b + a:b``. A name that is not a plain identifier is quoted with backticks or double quotes.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, NoReturn, TypeAlias, get_args
from unicodedata import normalize

from meshmatch.errors import OptionError

Space = Literal["form", "shape"]
Term: TypeAlias = "tuple[Factor, ...]"
_MAX_LENGTH, _MAX_TERMS, _MAX_FACTORS = 1000, 50, 3
_TOKEN = re.compile(r"\s*(?:`([^`]+)`|\"([^\"]+)\"|([^\W\d][\w.]*)|(\S))")
_FUNCTIONS = "log", "factor"
_HINT = "such as 'shape ~ log(size) + sex * age': names of columns, log(), factor(), +, : and *"


@dataclass(frozen=True)
class Factor:
    """A column: unchanged, its natural logarithm ("log"), or its values as categories ("factor")."""

    column: str
    function: Literal["", "log", "factor"] = ""

    def __str__(self) -> str:
        return f"{self.function}({self.column})" if self.function else self.column


@dataclass(frozen=True)
class Formula:
    """A parsed formula: the response, "shape" (without size) or "form" (with size), and the terms.

    Main effects come before interactions.
    """

    space: Space
    terms: tuple[Term, ...]

    def __str__(self) -> str:
        return f"{self.space} ~ {' + '.join(map(term_name, self.terms))}"

    @property
    def columns(self) -> tuple[str, ...]:
        """Distinct names of the columns, in order."""
        return tuple(dict.fromkeys(factor.column for term in self.terms for factor in term))


def term_name(term: Sequence[Factor]) -> str:
    """Format a term as in a formula."""
    return ":".join(map(str, term))


def parse(text: str) -> Formula:
    """Parse a formula; `OptionError` if it is invalid."""
    if len(text) > _MAX_LENGTH:
        raise OptionError(f"a formula of {len(text)} letters is too long", f"at most {_MAX_LENGTH}")
    return _Parser(text).formula()


class _Parser:
    """Recursive-descent parser of a formula: a sum of products of interactions of factors."""

    def __init__(self, text: str) -> None:
        self._text = text = normalize("NFC", text.strip())
        self._tokens = [(quoted or also or word, mark) for quoted, also, word, mark in _TOKEN.findall(text)]
        self._position = 0

    def formula(self) -> Formula:
        space = self._word("must begin with 'shape ~' or 'form ~'")
        if space not in get_args(Space) or not self._accept("~"):
            self._fail("does not begin with 'shape ~' or 'form ~'")
        terms: dict[frozenset[Factor], Term] = {}
        while True:
            for term in self._product():
                terms.setdefault(frozenset(term), term)
            if not self._accept("+"):
                break
        if self._position < len(self._tokens):
            word, mark = self._tokens[self._position]
            self._fail(f"has {word or mark!r} where + : * or its end was expected")
        if len(terms) > _MAX_TERMS:
            self._fail(f"has {len(terms)} terms, more than {_MAX_TERMS}")
        for term in terms.values():
            missing = [factor for factor in term if frozenset([factor]) not in terms]
            if missing:
                raise OptionError(
                    f"the formula has {term_name(term)} without {missing[0]}", f"write {'*'.join(map(str, term))}"
                )
        return Formula(space, tuple(sorted(terms.values(), key=len)))  # type: ignore[arg-type]

    def _product(self) -> list[Term]:
        parts = [self._interaction()]
        while self._accept("*"):
            parts.append(self._interaction())
            if len(parts) > _MAX_FACTORS:
                self._fail(f"joins more than {_MAX_FACTORS} names")
        chosen = (some for count in range(1, len(parts) + 1) for some in combinations(parts, count))
        found = [tuple(dict.fromkeys(factor for part in some for factor in part)) for some in chosen]
        if max(map(len, found)) > _MAX_FACTORS:
            self._fail(f"joins more than {_MAX_FACTORS} names")
        return found

    def _interaction(self) -> Term:
        factors = [self._factor()]
        while self._accept(":"):
            factors.append(self._factor())
        return tuple(dict.fromkeys(factors))

    def _factor(self) -> Factor:
        name = self._word("needs a name")
        if not self._accept("("):
            return Factor(name)
        if name not in _FUNCTIONS:
            self._fail(f"has the function {name!r}, which is not one of {', '.join(_FUNCTIONS)}")
        found = Factor(self._word(f"needs a name in {name}()"), name)  # type: ignore[arg-type]
        if not self._accept(")"):
            self._fail(f"has no ) behind {found.column}")
        return found

    def _word(self, problem: str) -> str:
        """Consume a name; ``problem`` continues the message if there is none."""
        word, mark = self._tokens[self._position] if self._position < len(self._tokens) else ("", "")
        if not word:
            self._fail(f"{problem}, not {mark!r}" if mark else f"{problem}: it ends early")
        self._position += 1
        return word

    def _accept(self, mark: str) -> bool:
        """Consume a punctuation mark if it comes next."""
        if self._position < len(self._tokens) and self._tokens[self._position] == ("", mark):
            self._position += 1
            return True
        return False

    def _fail(self, problem: str) -> NoReturn:
        """Raise `OptionError`."""
        raise OptionError(f"the formula '{self._text[:60]}' {problem}", _HINT)
