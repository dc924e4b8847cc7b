"""Commands and flags of earlier versions, which have other names today, or are gone. The next release removes them."""

from __future__ import annotations

import sys

_MOVED = {
    "rehearse": "stress --faults",
    "compare": "report",
    "distill": "train --teacher",
    "demos info": "demos select",
    "export lerobot": "export episodes",
    "export npz": "export episodes",
}
"""Command -> its present words."""
_RENAMED = {
    "--backend": "--engine",
    "--objects": "--meshes",
    "--like": "--recipe",
    "--fault": "--property",
    "engines compare --only": "--object",
    "engines compare --json": "--out",
    "engines check --json": "--out",
    "engines check --page": "--out",
    "objects import --png": "--picture",
    "--draw.per-family": "--per-family",
    "--draw.seed": "--seed",
    "--draw.upright": "--upright",
    "--draw.no-upright": "--no-upright",
    "view --png": "--out",
    "view --mp4": "--out",
    # names of objects, as always
    "demos synth --objects": "--objects",
    "demos select --objects": "--objects",
}
"""Flag, or command and flag -> the flag's present name."""
_NEEDLESS = {
    "--verbose": "checks that --check names show every number",
    "--resume": "a training continues with --out RUN alone, or with its whole command",
}
"""Flag that is ignored -> why."""
_SQUEEZE = (
    "fingers press with --squeeze.force and the object's weight, in balance; with --squeeze.force 0"
    " no finger presses"
)
_GONE = {
    "select": "evaluate checkpoints, xreset eval RUN/checkpoints/NUMBER.pt, and compare them with xreset report",
    "engines attribute": "xreset engines check measures engines, xreset stress what a policy tolerates",
    "engines trace": "xreset engines compare plays grasps in several engines, xreset report films policies in them",
    "demos synth --fps": "demonstrations have 30 frames a second; xreset.synthesize in Python takes fps",
    "--apart": "runs that differ only in their seed share a row; xreset report RUN shows one of them",
    "--curve": "the page has success, grasps and return, and TensorBoard shows all curves",
    "--x": "curves are drawn over minutes, and TensorBoard draws them over any axis",
    "--density": "write it into NAME.toml of the folder of objects, and import this folder",
    "--tolerance": "write it into NAME.toml of the folder of objects, and import this folder",
    "--settle": "episodes begin as recorded, because starts at rest gained nothing",
    "--squeeze.weight": _SQUEEZE,
    "--squeeze.balanced": _SQUEEZE,
    "--squeeze.no-balanced": _SQUEEZE,
    "--squeeze.reach": _SQUEEZE,
}
"""Command or flag -> what to do, or what is done, in place of it."""


def with_present_words(argv: list[str]) -> list[str]:
    """Return the arguments with the present names of commands and flags, and print what was renamed. For a command or a
    flag that is gone, the program ends with 2."""
    for count in (1, 2):
        command = " ".join(argv[:count])
        _refuse_gone(command)
        if command in _MOVED:
            present = _MOVED[command]
            _say_renamed(command, present)
            if command == "distill" and argv[1:2] and argv[1].startswith("-"):
                present = "train"  # continues a run, and names no teacher
            argv = [*present.split(), *argv[count:]]
            break
    command = " ".join(argv[:2])
    words = []
    renamed = {}
    for word in argv:
        flag, equals, value = word.partition("=")
        present = flag
        for known in (flag, f"{argv[0]} {flag}", f"{command} {flag}"):
            present = _RENAMED.get(known, present)
        if present != flag:
            renamed[flag] = present
        if flag.startswith("--vision."):
            present = f"--config.task.{flag[2:]}"
        if flag.startswith("--"):
            _refuse_gone(flag)
            _refuse_gone(f"{command} {flag}")
        if flag in _NEEDLESS:
            print(f"xreset: {flag} is gone: {_NEEDLESS[flag]}.", file=sys.stderr)
        else:
            words.append(present + equals + value)
    for flag, present in renamed.items():
        _say_renamed(flag, present)
    return words


def _refuse_gone(word: str) -> None:
    if word in _GONE:
        print(f"xreset: {word} is gone: {_GONE[word]}.", file=sys.stderr)
        raise SystemExit(2)


def _say_renamed(earlier: str, present: str) -> None:
    print(
        f"xreset: {earlier} is now {present}. The next release removes {earlier}.", file=sys.stderr
    )
