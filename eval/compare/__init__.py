"""Several trainings side by side: one picture and one table, and what makes the comparison unfair.

from xreset.eval.compare import compare
compare(["X-RESET=runs/a", "fixed gravity=runs/b", "runs/ik-ur7e-sharpa"], Path("runs/compare"))      # compare.png and compare.md
"""

from xreset.eval.compare.make import Comparison, compare

__all__ = ["Comparison", "compare"]
