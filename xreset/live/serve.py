"""Serve a policy over a WebSocket: readings in, joint targets out, as JSON.

WebSockets are understood by every language and pass through every proxy. A message has a few hundred numbers, for which
JSON needs no library and loses no digit. ``docs/live.md`` has the messages.
"""

from __future__ import annotations

import json
import logging
import socket
from collections.abc import Callable
from typing import Any

import numpy as np

from xreset.errors import XResetError, needs
from xreset.files.checks import check_port
from xreset.runtime import Controller, LiveError, OnnxActor, Reading
from xreset.runtime.remote import LIVE_SCHEMA
from xreset.runtime.rotations import is_unit

with needs("websockets", "serve"):
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.server import Server, ServerConnection, serve

_MAX_MESSAGE_BYTES = 1 << 20
_MOST_CLIENTS = 16
"""Each has a network of its own in memory."""
_PING_TIMEOUT = 5.0
"""Time in which a client must answer a ping, and time between pings [s]."""


Message = dict[str, Any]
"""A message of ``docs/live.md``, or the part of it below its verb."""


class PolicyServer:
    """Listens until it is closed. Each client has an episode of its own."""

    def __init__(
        self, contract: dict[str, Any], policy: bytes, *, host: str = "127.0.0.1", port: int = 8765
    ) -> None:
        """Start listening.

        Args:
            contract: the policy's contract.
            policy: content of its ONNX file.
            host: address to listen at. Any other than 127.0.0.1 lets other computers use the policy.
            port: port to listen at; 0: any free port.

        Raises:
            XResetError: the port is taken or impossible, or the address is not this machine's.
        """
        check_port(port)
        self._contract = contract
        self._policy = policy
        self._clients: set[ServerConnection] = set()
        self._log = logging.getLogger("xreset")
        try:
            is_ipv6 = ":" in host
            family = socket.AF_INET6 if is_ipv6 else socket.AF_INET
            self._server: Server = serve(
                self._answer_client,
                sock=socket.create_server((host, port), family=family),
                origins=[None],  # no page in a browser
                max_size=_MAX_MESSAGE_BYTES,
                compression=None,
                ping_interval=_PING_TIMEOUT,
                ping_timeout=_PING_TIMEOUT,
                close_timeout=1.0,
            )
        except OSError as error:
            raise XResetError(
                f"Cannot listen at {host}:{port}: {error.strerror}. Choose another --port or --host."
            ) from error
        name = f"[{host}]" if is_ipv6 else host
        self.url = f"ws://{name}:{self._server.socket.getsockname()[1]}"

    def serve(self) -> None:
        """Serve until :meth:`close`."""
        self._server.serve_forever()

    def close(self) -> None:
        """Stop listening, and end all connections."""
        self._server.shutdown()
        for client in tuple(self._clients):
            client.close()

    def _answer_client(self, client: ServerConnection) -> None:
        """Answer a client until it disconnects."""
        who = "{}:{}".format(*client.remote_address[:2])
        if len(self._clients) >= _MOST_CLIENTS:
            client.close(
                1013, f"{_MOST_CLIENTS} clients are connected, which is the largest number"
            )
            return
        try:
            self._clients.add(client)
            self._log.warning("%s has connected.", who)
            episode = _Episode(Controller(self._contract, OnnxActor(self._policy)))
            client.send(json.dumps({"schema": LIVE_SCHEMA, "contract": self._contract}))
            for message in client:
                client.send(json.dumps(episode.answer(message)))
            self._log.warning("%s has disconnected.", who)
        except ConnectionClosed:
            self._log.warning("The connection to %s was lost.", who)
        finally:
            self._clients.discard(client)


class _Episode:
    """Answers the messages of one client."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._has_begun = False
        self._verbs: dict[str, Callable[[Message], Message]] = {
            "begin": self._begin,
            "goal": self._goal,
            "step": self._step,
        }

    def answer(self, message: str | bytes) -> Message:
        """Return the answer to a message, or ``{"error": SENTENCE}`` if it cannot be answered."""
        try:
            try:
                data = json.loads(message)
            except (ValueError, RecursionError) as error:
                raise LiveError(f"The message is not JSON ({error}).") from error
            if not isinstance(data, dict) or len(data) != 1 or not set(data) <= set(self._verbs):
                keys = ", ".join(self._verbs)
                raise LiveError(f"The message needs exactly one key. Choose from: {keys}.")
            (verb,) = data
            if not isinstance(data[verb], dict):
                raise LiveError(f"{verb} is not an object.")
            if verb != "begin" and not self._has_begun:
                raise LiveError("There is no episode yet. Send begin first.")
            return self._verbs[verb](data[verb])
        except LiveError as error:
            return {"error": str(error)}

    def _begin(self, given: Message) -> Message:
        controller = self._controller
        contract = controller.contract
        if given.get("object") is not None:
            name = str(given["object"])
            points = controller.points(name)
            center = controller.center(name)
        else:
            points = _numbers(given, "points", contract["observation"]["cloud_points"], 3)
            center = _numbers(given, "center", 3) if "center" in given else None
        target = _numbers(given, "target", len(contract["joints"]))
        controller.begin(points, *_goal(given), target, center)
        self._has_begun = True
        return {"begun": True}

    def _goal(self, given: Message) -> Message:
        self._controller.set_goal(*_goal(given))
        return {"goal": True}

    def _step(self, given: Message) -> Message:
        contract = self._controller.contract
        joints = len(contract["joints"])
        force = None
        if given.get("tip_force") is not None:
            force = _numbers(given, "tip_force", len(contract["fingertips"]), 3)
        reading = Reading(
            joint_pos=_numbers(given, "joint_pos", joints),
            joint_vel=_numbers(given, "joint_vel", joints),
            joint_time=0.0,
            object_pos=_numbers(given, "object_pos", 3),
            object_quat=_quaternion(given, "object_quat"),
            object_time=0.0,
            tip_force=force,
        )
        self._controller.check_reading(reading)
        return {"target": self._controller.step(reading)[0].tolist()}


def _numbers(given: Message, name: str, *shape: int) -> np.ndarray:
    """Return an entry of a message as an array of that shape."""
    try:
        value = np.array(given[name], dtype=np.float32)
    except KeyError:
        raise LiveError(f"{name} is missing.") from None
    except (TypeError, ValueError, OverflowError):
        raise LiveError(f"{name} holds something that is not a number.") from None
    if value.shape != shape or not np.isfinite(value).all():
        raise LiveError(
            f"{name} has shape {value.shape}, or numbers that are not finite. "
            f"Expected finite numbers of shape {shape}."
        )
    return value


def _goal(given: Message) -> tuple[np.ndarray, np.ndarray]:
    return _numbers(given, "goal_pos", 3), _quaternion(given, "goal_quat")


def _quaternion(given: Message, name: str) -> np.ndarray:
    value = _numbers(given, name, 4)
    if not is_unit(value):
        raise LiveError(
            f"{name} has length {np.linalg.norm(value):.3f}, expected a unit quaternion (w, x, y, z)."
        )
    return value
