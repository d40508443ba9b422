"""The checks of types and shapes that tests put on every function of the package.

jaxtyping's import hook decorates each function, those inside functions anew at every call of the outer one, with its
`jaxtyped`. That compiles two functions for each, which takes a millisecond, and checks the arguments twice. Here the
checks of a function are compiled at its first call and once for all closures of one `def`, and arguments are checked
once; the names of axes are looked after only where a function has some. What is checked is the same: the arguments
before the call, what it returns after it, with one meaning of the names of axes for both.

A search calls the same small function ten thousand times with the same shapes. So each test checks the first calls of
each function, and of the later ones a share.
"""

import inspect
from collections.abc import Callable, Hashable
from dataclasses import is_dataclass
from functools import wraps
from types import FunctionType
from typing import Any, ForwardRef, Literal, TypeVar, get_args, get_origin

import jaxtyping
from beartype import beartype
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import config

_jaxtyped = jaxtyping.jaxtyped
_axes_of_one_call = _jaxtyped("context")
"""Names of axes have new meanings within; it holds nothing, so that one serves all calls."""

FIRST_CALLS, LATER_SHARE = 100, 20
"""Calls of a function that a test checks at first; of those that follow, one of so many is checked."""
_test = 0
"""Number of the test that runs."""


def begin_test() -> None:
    """Lets the first calls of all functions be checked again."""
    global _test
    _test += 1


class Checks:
    """The checks of the arguments and of the result of functions with one code and the same annotations."""

    def __init__(self, function: FunctionType) -> None:
        self._resolved = {name: _resolved(each, function) for name, each in function.__annotations__.items()}
        self._result = self._resolved.pop("return", Any)
        self._function = function
        self._names_axes = any(map(_names_axes, (*self._resolved.values(), self._result)))
        self._compiled = False
        self._test, self._calls = _test, 0

    def compile(self) -> None:
        arguments = _empty_twin(self._function)
        arguments.__annotations__ = self._resolved
        self.arguments: Callable[..., Any] = beartype(arguments)

        def result(value: Any) -> Any:
            return value

        result.__annotations__ = {"return": self._result}
        result.__qualname__, result.__module__ = self._function.__qualname__, self._function.__module__
        self.result: Callable[[Any], Any] = beartype(result)
        self._compiled = True

    def call(self, function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        if self._test != _test:
            self._test, self._calls = _test, 0
        self._calls += 1
        if self._calls > FIRST_CALLS and self._calls % LATER_SHARE:
            return function(*args, **kwargs)
        if not self._compiled:
            self.compile()
        if not self._names_axes:
            return self._checked(function, args, kwargs)
        with _axes_of_one_call:
            return self._checked(function, args, kwargs)

    def _checked(self, function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        try:
            self.arguments(*args, **kwargs)
        except BeartypeCallHintViolation as error:
            raise jaxtyping.TypeCheckError(str(error)) from error
        value = function(*args, **kwargs)
        try:
            return self.result(value)
        except BeartypeCallHintViolation as error:
            raise jaxtyping.TypeCheckError(str(error)) from error


_checks: dict[Hashable, Checks] = {}


def checked(target: Any = None, *, typechecker: Any) -> Any:
    """A function with checks; a dataclass whose `__init__` has them. It stands for `jaxtyping.jaxtyped`.

    Raises (when called):
        jaxtyping.TypeCheckError: an argument or the result is not of the type or the shape of its annotation.
    """
    if target is None:
        return lambda each: checked(each, typechecker=typechecker)
    if inspect.isclass(target):
        if is_dataclass(target) and not hasattr(target.__init__, "has_checks"):
            target.__init__ = checked(target.__init__, typechecker=typechecker)
        return target
    if not isinstance(target, FunctionType) or _names_arguments(target):
        return _jaxtyped(target, typechecker=typechecker)
    key = (target.__code__, tuple((name, _meaning(each)) for name, each in target.__annotations__.items()))
    checks = _checks.get(key)
    if checks is None:
        checks = _checks[key] = Checks(target)

    @wraps(target)
    def function(*args: Any, **kwargs: Any) -> Any:
        if config.jaxtyping_disable:
            return target(*args, **kwargs)
        return checks.call(target, args, kwargs)

    function.has_checks = True  # type: ignore[attr-defined]
    return function


def _meaning(annotation: Any) -> Hashable:
    """What is equal for annotations that mean the same; jaxtyping makes a new type each time that one is written."""
    if inspect.isclass(annotation) and issubclass(annotation, jaxtyping.AbstractArray):
        return annotation.dtype, annotation.array_type, annotation.dim_str
    if isinstance(annotation, list):
        return tuple(map(_meaning, annotation))
    if get_args(annotation) and get_origin(annotation) is not Literal:
        return get_origin(annotation), tuple(map(_meaning, get_args(annotation)))
    return annotation if isinstance(annotation, Hashable) else id(annotation)


def _names_axes(annotation: Any) -> bool:
    """Whether an annotation has an array or a tree in it, or may have: a name in quotes is looked up later."""
    if isinstance(annotation, (list, tuple)):
        return any(map(_names_axes, annotation))
    if get_origin(annotation) is not Literal and get_args(annotation):
        return any(map(_names_axes, get_args(annotation)))
    if isinstance(annotation, TypeVar):
        return _names_axes((annotation.__bound__, *annotation.__constraints__))
    if inspect.isclass(annotation):
        return issubclass(annotation, jaxtyping.AbstractArray) or annotation.__module__.startswith("jaxtyping")
    return isinstance(annotation, (str, ForwardRef))


def _names_arguments(function: FunctionType) -> bool:
    """Whether a shape refers to an argument by its value, as `{width}` does."""
    return any("{" in str(each) for each in function.__annotations__.values())


def _resolved(annotation: Any, function: FunctionType) -> Any:
    """An annotation that is a string as the type that it names, anything where it names none at run time."""
    if not isinstance(annotation, str):
        return annotation
    try:
        return eval(annotation, function.__globals__)
    except NameError:
        return Any


def _empty_twin(function: FunctionType) -> FunctionType:
    """A function with the name and the parameters of another that does nothing."""
    code = function.__code__
    positional, total = code.co_argcount, code.co_argcount + code.co_kwonlyargcount
    words = list(code.co_varnames[:positional])
    if code.co_posonlyargcount:
        words.insert(code.co_posonlyargcount, "/")
    has_more = bool(code.co_flags & inspect.CO_VARARGS)
    if has_more or total > positional:
        words.append("*" + code.co_varnames[total] if has_more else "*")
    words += code.co_varnames[positional:total]
    if code.co_flags & inspect.CO_VARKEYWORDS:
        words.append("**" + code.co_varnames[total + has_more])
    scope: dict[str, Any] = {}
    exec(f"def twin({', '.join(words)}): pass", scope)
    twin: FunctionType = scope["twin"]
    twin.__defaults__, twin.__kwdefaults__ = function.__defaults__, function.__kwdefaults__
    twin.__name__, twin.__qualname__ = function.__name__, function.__qualname__
    twin.__module__ = function.__module__
    return twin


jaxtyping.jaxtyped = checked
