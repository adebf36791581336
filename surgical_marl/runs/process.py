"""The process that runs: its standard streams, the encoding of names, the signals that end it."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import stat
import sys
from collections.abc import Iterable, Iterator
from typing import Any


class _Lasting:
    """A standard stream whose reader may leave: text that nobody can read is dropped, and no error.

    Args:
        stream: of text.
        optional: whether all errors are dropped, because nothing but progress goes there. Otherwise a full disk is one.
    """

    def __init__(self, stream: Any, optional: bool) -> None:
        self._stream, self._optional = stream, optional

    def write(self, text: str) -> int:
        """Write a text, or drop it."""
        with self._forgiving():
            self._stream.write(text)
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write texts, or drop them."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Pass on the buffered text, or drop it."""
        with self._forgiving():
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @contextlib.contextmanager
    def _forgiving(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            forgiven = self._optional or self._has_lost_its_reader(error)
            with contextlib.suppress(OSError):  # what is buffered would fail again when Python ends
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())
            if not forgiven:
                raise

    def _has_lost_its_reader(self, error: OSError) -> bool:
        closed = error.errno == errno.EIO and stat.S_ISCHR(os.fstat(self._stream.fileno()).st_mode)
        return closed or error.errno == errno.EPIPE


@contextlib.contextmanager
def lasting_streams() -> Iterator[None]:
    """Let work go on where nobody reads stdout or stderr any more: a pipe is closed (`| head`), a terminal is gone."""
    with (
        contextlib.redirect_stdout(_Lasting(sys.stdout, optional=False)),
        contextlib.redirect_stderr(_Lasting(sys.stderr, optional=True)),
    ):
        try:
            yield
        finally:
            sys.stdout.flush()
            sys.stderr.flush()


def open_streams() -> None:
    """Make stdin, stdout and stderr of a program usable.

    The null device takes the place of those that are closed: else the next file that is opened would have their number.
    A character that the encoding of stdout lacks is written as an escape.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, mode, encoding="utf-8"))  # noqa: SIM115  # for as long as Python runs
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")


def use_utf8() -> None:
    """Start this program again in Python's UTF-8 mode, if names of files have another encoding here.

    It reads and writes names and arguments as on any other machine then. What a terminal gets keeps its encoding.
    """
    mode = ["-X", "utf8"]
    if sys.getfilesystemencoding() == "utf-8" or sys.orig_argv[1:3] == mode or not sys.executable:
        return
    own = {"PYTHONUTF8": "1", "PYTHONIOENCODING": f"{sys.stdout.encoding}:backslashreplace"}
    with contextlib.suppress(OSError):
        os.execve(sys.executable, [sys.executable, *mode, *sys.orig_argv[1:]], {**os.environ, **own})


def ending_signals() -> dict[int, Any]:
    """Return the signals that end this process, with their handlers.

    They are SIGINT and SIGTERM, and SIGHUP, SIGUSR1 and SIGUSR2 unless something handles or ignores them already, as
    `nohup` ignores SIGHUP.
    """
    always = {number: signal.getsignal(number) or signal.SIG_DFL for number in (signal.SIGINT, signal.SIGTERM)}
    names = [name for name in ("SIGHUP", "SIGUSR1", "SIGUSR2") if hasattr(signal, name)]
    found = {getattr(signal, name): signal.getsignal(getattr(signal, name)) for name in names}
    return always | {number: handler for number, handler in found.items() if handler is signal.SIG_DFL}
