"""Writes the deployed graphs of the policies that ship with xreset: ci/ship_graphs.py

Run it after a policy was added, or after the code of observations or actions has changed. Graphs have the contract of
the training that the policy's own file states.
"""

from __future__ import annotations

import onnx

from xreset.eval.policy_spec import load_policy
from xreset.live.deploy import with_metadata
from xreset.policy.onnx_policy import METADATA_KEY, VERSION_KEY
from xreset.policy.shipped import FOLDER, shipped


def main() -> None:
    folder = FOLDER / "graphs"
    folder.mkdir(exist_ok=True)
    for name, file in shipped().items():
        policy = load_policy(file)
        if policy.task.vision.cameras:
            continue
        stated = {entry.key: entry.value for entry in onnx.load(file).metadata_props}
        own = {key: stated[key] for key in (METADATA_KEY, VERSION_KEY) if key in stated}
        (folder / f"{name}.onnx").write_bytes(with_metadata(policy.graph, own))
        print(name)


if __name__ == "__main__":
    main()
