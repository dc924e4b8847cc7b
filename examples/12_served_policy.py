"""A client of `xreset serve`: readings go out, joint targets come back. It needs websockets and nothing else.

Any language with WebSockets and JSON can do the same. On a robot, use `runtime.RemoteController` with a driver: it also
checks limits, and stops the robot when the server goes.
"""

import json
import statistics
import sys
import time

from websockets.exceptions import WebSocketException
from websockets.sync.client import connect


def main(url: str = "ws://127.0.0.1:8765", steps: int = 300) -> None:
    """Ask for targets of a robot that rests at home, and print how long the answers take."""
    try:
        connection = connect(url, max_size=None, compression=None)
    except (OSError, WebSocketException) as error:
        raise SystemExit(
            f"No policy is served at {url} ({error}). Start it: xreset serve POLICY"
        ) from None
    with connection as server:

        def ask(**message: dict) -> dict:
            server.send(json.dumps(message))
            answer = json.loads(server.recv(timeout=5))
            if "error" in answer:
                raise SystemExit(answer["error"])
            return answer

        hello = json.loads(server.recv(timeout=5))
        assert hello["schema"] == "xreset-live/1", hello
        contract = hello["contract"]
        home = [joint["home"] for joint in contract["joints"]]
        upright = [1.0, 0.0, 0.0, 0.0]  # w, x, y, z
        name = next(iter(contract["objects"]))
        ask(
            begin={
                "object": name,
                "goal_pos": [0.5, 0.3, 0.2],
                "goal_quat": upright,
                "target": home,
            }
        )
        reading = {
            "joint_pos": home,
            "joint_vel": [0.0] * len(home),
            "object_pos": [0.5, 0.3, 0.05],
            "object_quat": upright,
        }
        times = []
        for _ in range(steps):
            began = time.perf_counter()
            target = ask(step=reading)["target"]
            times.append(1000 * (time.perf_counter() - began))
    print(f"{name}: {len(target)} joint targets, the first is {target[0]:.3f} rad")
    print(
        f"an answer takes {statistics.mean(times):.1f} ms, the slowest of a hundred {statistics.quantiles(times, n=100)[-1]:.1f} ms"
    )


if __name__ == "__main__":
    main(*sys.argv[1:2])
