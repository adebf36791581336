"""Find classes by name: shipped, of installed packages, or registered by a program."""

from __future__ import annotations

import pkgutil
import sys
from collections.abc import Callable
from functools import cached_property, lru_cache, partial
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, NamedTuple

from surgical_marl.content import unknown
from surgical_marl.plugins.task_file import file_of


class Source(NamedTuple):
    """The origin of a class."""

    where: str
    load: Callable[[], Any]


class Registry:
    """Classes by name. Names are found without importing the classes.

    Args:
        noun: word for one of the classes, for messages.
        package: the package of the shipped classes: for each name a module or folder with one subclass of `base`.
            None if no class ships.
        group: the entry-point group in which an installed package declares its classes as `name = "module:Class"`.
        base: "module:Class", which all of them are subclasses of.
    """

    def __init__(self, noun: str, package: str | None, group: str, base: str) -> None:
        self.noun, self.package, self.group, self.base = noun, package, group, base
        self._registered: dict[str, type] = {}

    def names(self) -> list[str]:
        """Return all names, sorted."""
        return sorted(self._sources())

    def check(self, name: str) -> None:
        """Raise a ValueError that names the known ones if there is no such name."""
        if name not in (names := self.names()):
            raise unknown(self.noun, name, names)

    def load(self, name: str) -> Any:
        """Return the class of a name.

        Raises:
            ValueError: there is no such name or more than one, or its package cannot be imported or holds something
                else under it.
        """
        self.check(name)
        sources = self._sources()[name]
        if len(sources) > 1:
            where = " and of ".join(source.where for source in sources)
            raise ValueError(f"the {self.noun} {name!r} is of {where}: uninstall or rename all but one")
        (source,) = sources
        try:
            found = source.load()
        except Exception as error:  # a module of another package may raise anything
            reason = f"{type(error).__name__}: {error}"
            raise ValueError(f"the {self.noun} {name!r} of {source.where} cannot be imported: {reason}") from error
        self._check_class(name, source.where, found)
        return found

    def register(self, name: str, cls: type) -> None:
        """Add a class of this program. Defining it again, as in a notebook, replaces it.

        A class that its package declares by an entry point, too, is there already.

        Raises:
            ValueError: the name belongs to another class, or the class is not a subclass of `base`.
        """
        where = _where(cls)
        self._check_class(name, where, cls)
        own = name, cls.__module__, cls.__qualname__
        if own in ((point.name, point.module, point.attr) for point in self._points):
            return
        taken = [source.where for source in self._sources().get(name, []) if source.where != where]
        if taken:
            raise ValueError(f"the {self.noun} {name!r} of {where} exists already, of {taken[0]}: choose another name")
        self._registered[name] = cls

    def _check_class(self, name: str, where: str, found: Any) -> None:
        if not isinstance(found, type) or not issubclass(found, self._base()):
            raise ValueError(f"the {self.noun} {name!r} of {where} must be a subclass of {self.base}, not {found!r}")

    def _base(self) -> type:
        module, _, name = self.base.partition(":")
        return getattr(import_module(module), name)

    def _sources(self) -> dict[str, list[Source]]:
        found: dict[str, list[Source]] = {}
        for name in self.shipped:
            found.setdefault(name, []).append(Source("surgical-marl", partial(self._load_shipped, name)))
        for point in self._points:
            where = f"the package {point.dist.name}" if point.dist else point.value
            found.setdefault(point.name, []).append(Source(where, point.load))
        for name, cls in self._registered.items():
            found.setdefault(name, []).append(Source(_where(cls), partial(_itself, cls)))
        return found

    @cached_property
    def shipped(self) -> list[str]:
        """Names of the classes of this package."""
        if self.package is None:
            return []
        modules = pkgutil.iter_modules(import_module(self.package).__path__)
        return [module.name for module in modules if not self.base.startswith(f"{self.package}.{module.name}.")]

    @cached_property
    def _points(self) -> list[EntryPoint]:
        return list(_installed(tuple(sys.path)).select(group=self.group))

    def _load_shipped(self, name: str) -> type:
        module, base = import_module(f"{self.package}.{name}"), self._base()
        classes = (each for each in vars(module).values() if isinstance(each, type) and issubclass(each, base))
        (cls,) = (each for each in classes if f"{each.__module__}.".startswith(f"{module.__name__}."))
        return cls


@lru_cache(maxsize=1)
def _installed(path: tuple[str, ...]) -> Any:
    """Return the entry points of all packages on a path. Reading them takes as long for one group as for all."""
    return entry_points()


def _itself(cls: type) -> type:
    return cls


def _where(cls: Any) -> str:
    """Return the origin of a class that a program defines."""
    if (path := file_of(cls)) is not None:
        return f"{path}:{cls.__qualname__}"
    return f"{getattr(cls, '__module__', 'this program')}.{getattr(cls, '__qualname__', cls)}"
