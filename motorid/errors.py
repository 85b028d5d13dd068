"""Errors for people: every message says what was expected, what came, and what to do; Ctrl-C while a command loads."""

import contextlib
import functools
import inspect
import numbers
import os
import re
import sys
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from contextvars import ContextVar
from itertools import pairwise
from types import TracebackType
from typing import Any, Protocol, TypeVar, cast, runtime_checkable


def _leave(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt):
        os.write(2, b"motorid: interrupted.\n")
        os._exit(130)
    sys.__excepthook__(kind, error, trace)


# As early as can be: what is imported after this module takes a second to load. Only for the command itself: a script
# that imports the package, whatever its name, keeps what Python does.
_NAME = os.path.basename("".join(sys.argv[:1]))
if ("-m", "motorid") in pairwise(sys.orig_argv) or _NAME in ("motorid", "motorid.exe"):
    sys.excepthook = _leave
    if not re.fullmatch(r"\d{1,10}", os.environ.get("SOURCE_DATE_EPOCH", "0")):
        del os.environ["SOURCE_DATE_EPOCH"]  # SciPy cannot be imported beside anything else


class MotoridError(Exception):
    """Base of every error that motorid raises on purpose; its text is one clear message for the user."""


class DataError(MotoridError):
    """A record cannot be read or cannot be used (exit status 2 on the command line)."""


class ModelError(MotoridError):
    """A model or an effect is not well formed, or does not fit the measured channels (exit status 2)."""


class UsageError(MotoridError):
    """A word, a name or an option is not known or does not go with another one (exit status 2)."""


class SimulationError(MotoridError):
    """An integration did not reach the end of the record (exit status 1)."""

    sample = 0  # the first whose state is not finite, where that is known


class FitError(MotoridError):
    """An estimation could not be carried out (exit status 1)."""


class OutputError(MotoridError):
    """The disk refuses an output, e.g. because it is full; what was there is as it was (exit status 1)."""


class DeviceError(MotoridError):
    """A bench on a serial port does not answer, refuses, or says what cannot be (exit status 1)."""


class MissingDependency(MotoridError):
    """An optional package is needed and not installed; the message names the extra to install."""


class OutOfTime(Exception):
    """A budget of time is spent; whoever set it keeps what there is so far, see `numerics.parallel.budget`."""


@contextlib.contextmanager
def numbers_told() -> Iterator[None]:
    """Turn what arithmetic raises at numbers beyond all bounds into a `FitError`; also a decorator."""
    try:
        yield
    except (ArithmeticError, ValueError) as error:
        if type(error) is ValueError and "infs or NaNs" not in str(error):
            raise
        raise FitError(f"the numbers of these records, or of this model, are beyond what can be computed ({error}). "
                       "Look at the units of the columns, and at the values that were set.") from error


LARGEST = 1e12  # of any number asked for in SI units: its square is far from the end of the numbers


@runtime_checkable
class _Wire(Protocol):
    read: Any
    write: Any
    close: Any


_T = TypeVar("_T")


def otherwise(default: _T, failures: type[Exception] | tuple[type[Exception], ...], asked: Callable[[], _T]) -> _T:
    """Return what is asked for, or a default where that fails so."""
    try:
        return asked()
    except failures:
        return default


_Thing = TypeVar("_Thing", bound=Callable[..., Any])
_SCALAR = {"float", "int", "bool", "str", "None"}
_PLAIN = _SCALAR | {"Sequence", "Iterable", "Mapping", "tuple", "Callable", "Map", "Callback", "object", "Any"}
_KINDS: dict[str, Any] = {**dict.fromkeys(("Path", "PathLike", "Path_"), (str, os.PathLike)), "Mapping": Mapping,
                          **dict.fromkeys(("Callable", "Map", "Callback"), Callable), "Records": object, "Link": _Wire,
                          **dict.fromkeys(("Sequence", "Iterable", "tuple", "Array", "ArrayLike"), Iterable)}
_choices = functools.cache(functools.partial(re.split, r" \| (?![^\[]*\])"))  # what an annotation allows
# Within a public call: what it calls in turn need not be looked at before it fails.
_within: ContextVar[bool] = ContextVar("motorid_within_a_call", default=False)


@contextlib.contextmanager
def looked_at() -> Iterator[None]:
    """Take the arguments of all calls in the block as looked at, as the command line has done."""
    token = _within.set(True)
    try:
        yield
    finally:
        _within.reset(token)


def arguments_told(thing: _Thing) -> _Thing:
    """Let a function, or what a class is made with and its methods, say which argument is not what its annotation says.

    Numbers, words, flags and lists of them are looked at in any case: many a wrong one does its harm without an error.
    All others only where the call fails, so that nothing that works is refused. What a class says itself goes first."""
    if isinstance(thing, type):
        for name, member in list(vars(thing).items()):
            if inspect.isfunction(member) and (name in ("__init__", "__add__", "__call__") or not name.startswith("_")):
                setattr(thing, name, arguments_told(member))
        return cast(_Thing, thing)

    signature = inspect.signature(thing)
    named = [p.replace(annotation=_named(p.annotation)) for p in signature.parameters.values()]
    signature = signature.replace(parameters=named, return_annotation=_named(signature.return_annotation))
    member = "." in thing.__qualname__
    plain = {p.name for p in signature.parameters.values()
             if set(re.findall(r"\w+", str(p.annotation))) <= (_SCALAR if member else _PLAIN)}

    @functools.wraps(thing)
    def call(*args: Any, **kwargs: Any) -> Any:
        within = _within.get()
        early = None if within else _wrong_argument(thing, signature, args, kwargs, plain)
        if early is not None and not member:
            raise UsageError(early)
        _within.set(True)
        try:
            found = thing(*args, **kwargs)
            if early is not None:
                raise UsageError(early)
            return found
        except (TypeError, AttributeError, ValueError, LookupError) as error:
            if (wrong := _wrong_argument(thing, signature, args, kwargs)) is None:
                raise
            raise UsageError(wrong) from error
        finally:
            _within.set(within)

    call.__dict__["__signature__"] = signature
    return cast(_Thing, call)


@functools.cache
def _named(annotation: Any) -> Any:
    """Return an annotation as it is written, without the modules of what it names."""
    if isinstance(annotation, type) or annotation is None:
        return annotation if annotation is inspect.Parameter.empty else getattr(annotation, "__name__", "None")
    return re.sub(r"(\w+\.)+(?=\w)", "", str(annotation)).replace("ndarray[tuple[Any, ...], dtype[float64]]", "Array")


def at_least(least: float, **given: float | None) -> None:
    """Refuse arguments below the least that makes sense; None is one left out."""
    for name, number in given.items():
        if number is not None and not number >= least:
            raise UsageError(f"{name} must be at least {least:g}; got {number}.")


def positive(hint: str = "", /, **given: float | None) -> None:
    """Refuse arguments that are not positive, or beyond what anything measures; None is one left out."""
    for name, number in given.items():
        if number is not None and not 0 < number <= LARGEST:
            raise UsageError(f"{name} must be positive and finite, at most {LARGEST:g}; got {number!r}.{hint}")


def _wrong_argument(function: Callable[..., Any], signature: inspect.Signature, args: Any, kwargs: Any,
                    among: Container[str] | None = None) -> str | None:
    try:
        given = signature.bind(*args, **kwargs).arguments
    except TypeError:  # Python says it well enough
        return None
    for name, value in given.items():
        asked = signature.parameters[name]
        if asked.annotation is asked.empty or (among is not None and name not in among):
            continue
        several = asked.kind in (asked.VAR_POSITIONAL, asked.VAR_KEYWORD)
        for one in (value.values() if isinstance(value, dict) else value) if several else (value,):
            if not _fits(one, str(asked.annotation)) and not (
                    isinstance(one, float) and one != one and asked.default != asked.default):
                return (f"{function.__qualname__.removesuffix('.__init__')}: {name} takes "
                        f"{str(asked.annotation).replace(' | ', ' or ')}; got "
                        f"{name_of(one)}{f' {one}' if isinstance(one, numbers.Number) else ''}.")
    return None


def _fits(value: Any, annotation: str) -> bool:
    """Tell whether a value is of the kind that an annotation names; of lists and mappings, all that is in them."""
    for choice in _choices(annotation):
        name, _, inner = choice.removesuffix("]").partition("[")
        if (name := name.rpartition(".")[2]) in ("Any", "object") or (name == "None" and value is None):
            return True
        kind = _KINDS.get(name)
        known = (_is_number(value, name) if name in ("float", "int", "bool") else isinstance(value, kind) if kind
                 else name in (c.__name__ for c in type(value).__mro__))
        single = isinstance(value, str | Mapping) or (inner and getattr(value, "ndim", 1) == 0)
        if not known or (kind is Iterable and single):
            continue
        if kind in (Iterable, Mapping) and inner and hasattr(value, "__len__"):
            parts = list(value.values() if isinstance(value, Mapping) else value)
            kinds = re.split(r", (?![^\[]*\])", inner)
            kinds = kinds if name == "tuple" and "..." not in kinds else [kinds[name == "Mapping"]] * len(parts)
            if len(parts) != len(kinds) or not all(map(_fits, parts, kinds)):
                continue
        return True
    return False


def _is_number(value: Any, kind: str) -> bool:
    """Tell whether a value is a number as meant: True is none, NaN is none, 1.5 is no count; of flags, 0 and 1 are."""
    flag = type(value).__name__ in ("bool", "bool_")
    if kind == "bool":
        return flag or (isinstance(value, numbers.Real) and value in (0, 1))
    real = isinstance(value, numbers.Real) or (getattr(value, "ndim", None) == 0 and hasattr(value, "__float__"))
    return not flag and real and value == value and (kind == "float" or isinstance(value, numbers.Integral))


_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    """Return `text` with control characters written out, so that no name gives orders to a terminal."""
    return _CONTROLS.sub(lambda m: m[0].encode("unicode_escape").decode(), text)


def name_of(thing: object) -> str:
    """Return what a message calls an argument that is not what was expected."""
    return repr(thing) if isinstance(thing, str) else getattr(thing, "__name__", type(thing).__name__)


def among(word: object, known: Iterable[object], what: str, error: type[MotoridError] = UsageError,
          where: str = "") -> None:
    """Raise `error` unless `word` is among the `known` names of `what`; `where` begins its message."""
    if word not in (known := list(known)):
        raise error(where + one_of(str(word), known, what))


def chosen(names: Iterable[str] | None, known: Iterable[str], what: str) -> list[str]:
    """Return `names`, by default all that are `known`; UsageError for one that is none of these."""
    for name in names or ():
        among(name, known, what)
    return list(names or known)


def one_of(word: str, known: Iterable[object], what: str) -> str:
    """Say that `word` is not among the `known` names of `what`, and which one may have been meant."""
    import difflib

    names = [str(k) for k in known]
    near = difflib.get_close_matches(str(word), names, n=1, cutoff=0.5)
    hint = f" Did you mean '{near[0]}'?" if near else ""
    return f"unknown {what} '{word}'.{hint} Known: {', '.join(names) or 'none'}."
