"""Policies that answer over a websocket, as openpi serves them: `socket:HOST:PORT,rate=10,actions=joint`.

Messages are msgpack, with arrays as openpi's msgpack_numpy has them: {b"__ndarray__": True, b"data": bytes, b"dtype":
"<f4", b"shape": [...]}. The server first sends a map, its metadata. Then it gets a map for each episode that is due:

    observation.state, observation.environment_state     float32 [numbers]
    observation.images.<picture>                          uint8 [height, width, 3]
    prompt                                                the task in words

and answers a map with `actions` [horizon, numbers], or a text, which is an error. `rate`, `actions`, `observes`,
`size` and `horizon` may also stand in its metadata.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from surgical_marl.policies.adapter import PICTURE, STATE, TASK, PolicyAdapter
from surgical_marl.untrusted.values import one_line

WAIT, ANSWER = 10.0, 600.0
"""Seconds for which a server may take to open, and to answer: the first answer may wait for a compiler."""
MOST = 1 << 28
"""Bytes of an answer."""
KINDS = "biuf"
"""Kinds of numbers that an answer may hold, as numpy names them."""


class SocketPolicy(PolicyAdapter):
    """A policy behind a websocket. It is asked once for each episode, because servers know no batches.

    Args:
        place: HOST:PORT.
        cameras: pictures that it is sent, with + between them, such as endoscope+outside.
        size: of the pictures, WIDTHxHEIGHT.
    """

    def __init__(self, place: str, cameras: str = "", size: str = "224x224") -> None:
        self._codec, connect = _libraries()
        host, _, port = place.rpartition(":")
        if not host or not port.isdecimal() or int(port) > 65535:
            raise ValueError(f"write socket:HOST:PORT such as socket:localhost:8000, not {place!r}")
        try:
            self._socket = connect(f"ws://{place}", compression=None, max_size=MOST, open_timeout=WAIT)
            about = self._read()
        except (OSError, EOFError) as error:
            raise ValueError(f"nothing answers at {place}: {error}") from None
        self.rate, self.actions, self.horizon = about.get("rate"), about.get("actions"), about.get("horizon", 1)
        width, _, height = str(about.get("size", size)).partition("x")
        if not (width.isdecimal() and height.isdecimal()):
            raise ValueError(f"size must be WIDTHxHEIGHT such as 224x224, not {width}x{height}")
        names = about.get("observes", [STATE, TASK, *(PICTURE + name for name in cameras.split("+") if name)])
        picture = int(height), int(width), 3
        self.observes = {str(name): picture if str(name).startswith(PICTURE) else None for name in names}

    def act(self, batch: Mapping[str, Any]) -> np.ndarray:
        """Return actions [n, horizon, numbers] for what is observed in n episodes."""
        count = len(next(iter(batch.values())))
        episodes = ({key: _single(values[row]) for key, values in batch.items()} for row in range(count))
        return np.stack([self._ask(seen) for seen in episodes])

    def _ask(self, seen: dict[str, Any]) -> np.ndarray:
        if TASK in seen:
            seen["prompt"] = seen.pop(TASK)
        self._socket.send(self._codec.encode(_packed(seen)))
        answer = self._read()
        if "actions" not in answer:
            raise ValueError(f"the server's answer lacks actions: it has {sorted(map(str, answer))}")
        actions = np.asarray(answer["actions"], np.float32)
        if actions.ndim != 2 or len(actions) < self.horizon:
            wanted = f"[{self.horizon} or more, numbers]"
            raise ValueError(f"the server gives actions of shape {list(actions.shape)}, not {wanted}")
        return actions[: self.horizon]

    def _read(self) -> dict[Any, Any]:
        message = self._socket.recv(timeout=ANSWER)
        if isinstance(message, str):
            _, _, last = message.strip().rpartition("\n")  # of a traceback
            raise ValueError(f"the server says: {one_line(last)}")
        found = _unpacked(self._codec.decode(message))
        if not isinstance(found, dict):
            raise ValueError(f"the server sends {type(found).__name__} instead of a map")
        return found


def _libraries() -> tuple[Any, Any]:
    try:
        import msgspec.msgpack
        from websockets.sync.client import connect
    except ImportError as error:
        raise ValueError(f"the package {error.name} is not installed: pip install 'surgical-marl[socket]'") from None
    return msgspec.msgpack, connect


def _single(value: Any) -> Any:
    """Return what is observed in the last row."""
    return value if isinstance(value, str) else value[-1]


def _packed(value: Any) -> Any:
    """Return a value for msgpack, with arrays as maps."""
    if isinstance(value, dict):
        return {key: _packed(own) for key, own in value.items()}
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    return value


def _unpacked(value: Any) -> Any:
    """Return a value of msgpack, with maps that stand for arrays as these."""
    if isinstance(value, list):
        return [_unpacked(own) for own in value]
    if not isinstance(value, dict):
        return value
    if b"__ndarray__" not in value and b"__npgeneric__" not in value:
        return {key: _unpacked(own) for key, own in value.items()}
    kind = np.dtype(value[b"dtype"])
    if kind.kind not in KINDS:
        raise ValueError(f"the server sends an array of {kind}")
    if b"__npgeneric__" in value:
        return kind.type(value[b"data"])
    return np.frombuffer(value[b"data"], kind).reshape(value[b"shape"])
