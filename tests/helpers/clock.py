"""A wall clock that jumps, for one process: a library that the linker puts before the C library, and a file.

Only the clock of the day jumps, as where somebody sets a machine's clock. Clocks that measure durations go on:
libfaketime changes those too, and under it Python's `time.sleep` sometimes ends with an error.
"""

from __future__ import annotations

import shutil
import struct
import subprocess
import tempfile
from functools import cache
from pathlib import Path

_SOURCE = r"""
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static volatile long *ahead;

__attribute__((constructor)) static void open_file(void) {
    int file = open(getenv("CLOCK_AHEAD"), O_RDONLY);
    void *found = mmap(0, sizeof(long), PROT_READ, MAP_SHARED, file, 0);
    if (found == MAP_FAILED) abort();
    ahead = found;
    close(file);
}

int clock_gettime(clockid_t id, struct timespec *now) {
    int code = syscall(SYS_clock_gettime, id, now);
    if (!code && ahead && (id == CLOCK_REALTIME || id == CLOCK_REALTIME_COARSE)) now->tv_sec += *ahead;
    return code;
}

int gettimeofday(struct timeval *now, void *zone) {
    struct timespec exact;
    clock_gettime(CLOCK_REALTIME, &exact);
    now->tv_sec = exact.tv_sec;
    now->tv_usec = exact.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *where) {
    struct timespec exact;
    clock_gettime(CLOCK_REALTIME, &exact);
    if (where) *where = exact.tv_sec;
    return exact.tv_sec;
}
"""
HOUR, DAY = 3600, 86_400
JUMPS = (-400 * DAY, -HOUR, HOUR, 400 * DAY)
"""Seconds."""


@cache
def _library() -> Path | None:
    folder, compiler = Path(tempfile.mkdtemp()), shutil.which("cc")
    (folder / "clock.c").write_text(_SOURCE)
    command = [str(compiler), "-shared", "-fPIC", "-O1", "-o", "clock.so", "clock.c"]
    made = compiler and not subprocess.run(command, cwd=folder, capture_output=True).returncode
    return folder / "clock.so" if made else None


def can_jump() -> bool:
    """Return whether there is a C compiler that makes the library."""
    return _library() is not None


def own_clock(file: Path) -> dict[str, str]:
    """Return the variables with which a new process sees a clock that `jump` changes by way of a file."""
    jump(file, 0)
    return {"LD_PRELOAD": str(_library()), "CLOCK_AHEAD": str(file)}


def jump(file: Path, seconds: int) -> None:
    """Let the clock of all processes of a file be so many seconds ahead, or behind."""
    with file.open("r+b" if file.exists() else "wb") as there:
        there.write(struct.pack("@l", seconds))
