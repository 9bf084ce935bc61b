"""Check the types and shapes of array annotations at every call while tests run.

`install`, called by ``conftest.py`` before anything is imported, wraps functions with jaxtyping annotations when their
module is loaded. Other annotations are left to mypy. So are constructors, as dataclasses convert their arguments.
Annotations are parsed once for each function, as some functions are called many thousand times: with jaxtyping's own check
tests of fits take nearly twice as long.
"""

import inspect
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import wraps
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import ModuleType, UnionType
from typing import Any, Union, get_args, get_origin

import numpy as np
from jaxtyping import AbstractArray

Sizes = dict[str, Any]
Check = Callable[[Any, Sizes], bool]
"""Predicate: whether a value matches an annotation, given the sizes of named axes in this call; adds sizes of new names."""
ARRAYS = ("Float[", "Int[", "Bool[", "UInt8[")


def install(packages: Sequence[str]) -> None:
    """Check the functions of all modules of these packages that are loaded from now on."""
    sys.meta_path.insert(0, _Finder(tuple(packages)))


class _Finder:
    def __init__(self, packages: tuple[str, ...]) -> None:
        self.packages = packages

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if not any(name == package or name.startswith(f"{package}.") for package in self.packages):
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


class _Loader(SourceFileLoader):
    def exec_module(self, module: ModuleType) -> None:
        super().exec_module(module)
        classes = [value for value in vars(module).values() if inspect.isclass(value)]
        for holder in (module, *(each for each in classes if each.__module__ == module.__name__)):
            for name, value in list(vars(holder).items()):
                if inspect.isfunction(value) and value.__module__ == module.__name__ and _has_array_annotations(value):
                    setattr(holder, name, checked(value))


def _has_array_annotations(function: Callable[..., Any]) -> bool:
    arrays = any(_is_array_annotation(hint) for hint in function.__annotations__.values())
    return arrays and function.__name__ != "__init__" and not inspect.isgeneratorfunction(function)


def _is_array_annotation(hint: Any) -> bool:
    return any(kind in str(hint) for kind in ARRAYS)


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a function to raise `TypeError` for arrays that do not match its annotations."""
    order = list(inspect.signature(function).parameters)
    checks: dict[str, Check] | None = None

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal checks
        if checks is None:  # not earlier, as annotations may need circular imports
            checks = dict(_checks(function))
        sizes: Sizes = {}
        for given in (zip(order, args, strict=False), kwargs.items()):
            for name, value in given:
                check = checks.get(name)
                if check is not None and not check(value, sizes):
                    raise TypeError(f"parameter {name} is not {function.__annotations__[name]}, with {sizes}")
        result = function(*args, **kwargs)
        check = checks.get("return")
        if check is not None and not check(result, sizes):
            raise TypeError(f"the result is not {function.__annotations__['return']}, with {sizes}")
        return result

    return call


def _checks(function: Callable[..., Any]) -> Iterator[tuple[str, Check]]:
    for name, hint in function.__annotations__.items():
        if _is_array_annotation(hint):
            try:
                found = _check_of(eval(hint, function.__globals__) if isinstance(hint, str) else hint)
            except (AttributeError, NameError, TypeError):  # names imported for type checkers only
                continue
            if found is not None:
                yield name, found


def _check_of(hint: Any) -> Check | None:
    """Return the check of an annotation; None if it is not checked."""
    if inspect.isclass(hint) and issubclass(hint, AbstractArray):
        return _array_check(hint)
    inner = get_args(hint)
    if get_origin(hint) in (Union, UnionType):
        checks = [_check_of(each) for each in inner if each is not type(None)]
        if None in checks:
            return None
        optional = type(None) in inner
        return lambda value, sizes: optional if value is None else any(check(value, sizes) for check in checks)
    if get_origin(hint) is tuple and Ellipsis not in inner:
        each = [_check_of(part) or _accept_anything for part in inner]
        return lambda value, sizes: (
            isinstance(value, tuple)
            and len(value) == len(each)
            and all(check(part, sizes) for check, part in zip(each, value, strict=True))
        )
    return None


def _accept_anything(value: Any, sizes: Sizes) -> bool:
    return True


def _array_check(hint: Any) -> Check:
    kind, kinds = hint.array_type, set(hint.dtypes)
    dims: list[str | int] = [int(word) if word.isdigit() else word for word in hint.dim_str.split()]
    many = next((at for at, dim in enumerate(dims) if isinstance(dim, str) and dim.startswith(("*", "..."))), None)
    seen: set[Any] = set()  # accepted dtypes

    def check(value: Any, sizes: Sizes) -> bool:
        if not isinstance(value, kind):
            return False
        if value.dtype not in seen:
            if getattr(value.dtype, "name", str(value.dtype).removeprefix("torch.")) not in kinds:
                return False
            seen.add(value.dtype)
        shape, wanted = tuple(value.shape), dims
        if many is not None:
            after = len(dims) - many - 1
            if len(shape) < many + after or not _variadic_axes_match(
                str(dims[many]), shape[many : len(shape) - after], sizes
            ):
                return False
            shape = shape[:many] + shape[len(shape) - after :]
            wanted = dims[:many] + dims[many + 1 :]
        if len(shape) != len(wanted):
            return False
        for dim, size in zip(wanted, shape, strict=True):
            if type(dim) is int:
                if dim != size:
                    return False
            elif dim != "_" and sizes.setdefault(dim, size) != size:
                return False
        return True

    return check


def _variadic_axes_match(dim: str, shape: tuple[int, ...], sizes: Sizes) -> bool:
    """Return whether variadic axes match those of the same name: ``*#B`` may broadcast to them, ``...`` matches any."""
    if dim == "...":
        return True
    before = sizes.setdefault(dim.replace("#", ""), shape)
    if "#" not in dim:
        return bool(before == shape)
    try:
        return np.broadcast_shapes(before, shape) == before
    except ValueError:
        return False
