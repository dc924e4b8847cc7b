"""Steps of a study that take no time: a shell command that writes a file."""

from xreset.eval.study.steps import Step


def shell_step(name, writes, command, *needs):
    """Return a step that is done when its folder holds ``done``."""

    def todo():
        if (writes / "done").exists():
            return "", []
        return "to do", [["sh", "-c", f"mkdir -p {writes} && cd {writes} && {command}"]]

    return Step(name=name, kind="data", folder=writes, todo=todo, needs=needs)
