"""The report of an evaluation: one self-contained HTML page.

from xreset.eval.verbs import make_report
make_report("runs/soup")          # runs/soup/report/index.html
"""
