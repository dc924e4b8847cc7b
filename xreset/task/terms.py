"""Tables of named terms: functions that a configuration chooses, with their parameters.

A table maps names to parameters, such as ``{"reach": {"weight": 1.0, "width": 0.1}}``. A name is that of a function.
One function can be there twice: ``{"far": {"function": "reach", "width": 0.4}, ...}``. In a table that may have
functions of the user, they are called ``module:function``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from math import isfinite
from typing import Annotated, Any

from xreset.errors import RunError, WrongValueError
from xreset.files.checks import Rule, parsed_arguments


class Terms(dict[str, dict[str, Any]]):
    """Named terms, in order: name -> parameters, which are numbers, words, and true or false."""

    def __or__(self, others: Mapping[str, dict[str, Any]]) -> Terms:  # pyright: ignore
        """Return these terms and others, which replace those of the same names."""
        return Terms({**self, **others})


def _are_terms(terms: Any) -> bool:
    return isinstance(terms, dict) and all(
        isinstance(name, str) and isinstance(term, dict) and all(map(_is_value, term.values()))
        for name, term in terms.items()
    )


def _is_value(value: Any) -> bool:
    return isinstance(value, str) or (isinstance(value, int | float) and isfinite(value))


_FORM = "name -> parameter -> finite number or word"
Named = Annotated[Terms, Rule(f"terms: {_FORM}", _are_terms)]
OneTerm = Annotated[Terms, Rule(f"one term: {_FORM}", lambda x: _are_terms(x) and len(x) == 1)]


class Functions(dict[str, Callable[..., Any]]):
    """The functions that a table may name. The first argument of a function is its input, the others are parameters."""

    def __init__(self, kind: str, *, own: bool = False) -> None:
        """Start without functions.

        Args:
            kind: what messages call one of them.
            own: whether a table may also name functions of the user.
        """
        self._kind = kind
        self._own = own

    def add(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Decorate a function: add it under its own name."""
        self[function.__name__] = function
        return function

    def bound(self, where: str, terms: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        """Return the functions of a table, with their parameters, by name of the term.

        Functions of the user are as they are now: a notebook may have defined one again.

        Args:
            where: the table's place in the configuration, for messages.
            terms: the table.

        Raises:
            WrongValueError: a function is unknown, or a parameter is unknown, missing or wrong.
            RunError: a module of the user cannot be imported, or has no such function.
        """
        found = {}
        for name, term in terms.items():
            given = dict(term)
            function = self._find(name, given.pop("function", name))
            arguments, problems = parsed_arguments(function, given, f"{where}.{name}")
            if problems:
                raise WrongValueError("\n".join(problems))
            found[name] = partial(function, **arguments)
        return found

    def _find(self, term: str, function: str) -> Callable[..., Any]:
        if self._own and ":" in term:
            return _imported(self._kind, term)
        if function not in self:
            own = ""
            if self._own:
                own = "One of your own is named module:function. "
            elif ":" in function:
                own = "Only reward terms may be functions of your own. "
            raise WrongValueError(
                f"Unknown {self._kind} {function!r}. {own}Choose from: {', '.join(self)}."
            )
        return self[function]


def _imported(kind: str, name: str) -> Callable[..., Any]:
    """Return the function ``module:function`` of the user."""
    place, _, function = name.partition(":")
    try:
        module = import_module(place)
    except Exception as error:  # a user's module may fail in any way
        reason = f"{type(error).__name__}: {error}"
        is_missing = isinstance(error, ModuleNotFoundError) and place.startswith(str(error.name))
        fix = "Add its folder to PYTHONPATH." if is_missing else f"The error is in {place}."
        raise RunError(f"The {kind} {name!r} cannot be loaded ({reason}). {fix}") from error
    found = getattr(module, function, None)
    if not callable(found):
        file = getattr(module, "__file__", place)
        raise RunError(
            f"The {kind} {name!r}: {file} has no function {function!r}. Correct the name."
        )
    return found
