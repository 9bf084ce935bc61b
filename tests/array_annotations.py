"""Check the types and shapes that annotations promise of arrays, at every call while tests run.

`install`, called by ``conftest.py`` before anything is imported, wraps functions with jaxtyping annotations as their
module is loaded. Other annotations are left to mypy, and constructors too: dataclasses convert what they are given.
"""

import inspect
import sys
from collections.abc import Callable, Sequence
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import ModuleType, UnionType
from typing import Any, Union, get_args, get_origin

from jaxtyping import AbstractArray, jaxtyped


def install(packages: Sequence[str]) -> None:
    """Check the functions of all modules in these packages that are loaded from now on."""
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
                if inspect.isfunction(value) and value.__module__ == module.__name__ and _promises(value):
                    setattr(holder, name, jaxtyped(value, typechecker=checked))


def _promises(function: Callable[..., Any]) -> bool:
    texts = map(str, function.__annotations__.values())
    arrays = any(kind in text for text in texts for kind in ("Float[", "Int[", "Bool["))
    return arrays and function.__name__ != "__init__" and not inspect.isgeneratorfunction(function)


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """For jaxtyping, which turns a signature into a function: one that checks the arrays it is given."""
    signature = inspect.signature(function)
    hints = {name: parameter.annotation for name, parameter in signature.parameters.items()}

    def check(*args: Any, **kwargs: Any) -> Any:
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            if not fits(value, hints[name]):
                raise TypeError(f"{name} is not {hints[name]}")
        result = function(*args, **kwargs)  # by jaxtyping: the real result, handed through
        if not fits(result, signature.return_annotation):
            raise TypeError(f"the result is not {signature.return_annotation}")
        return result

    return check


def fits(value: Any, hint: Any) -> bool:
    """Whether the arrays in a value are what an annotation says; sizes of one name must agree within a call."""
    if inspect.isclass(hint) and issubclass(hint, AbstractArray):
        return isinstance(value, hint)
    inner = get_args(hint)
    if get_origin(hint) in (Union, UnionType):
        return any(value is None if each is type(None) else fits(value, each) for each in inner)
    if get_origin(hint) is tuple and Ellipsis not in inner:
        return isinstance(value, tuple) and len(value) == len(inner) and all(map(fits, value, inner))
    return True
