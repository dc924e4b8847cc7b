"""The report of an evaluation: one self-contained HTML page.

from xreset.eval.report.make import make_report
make_report(Path("runs/soup"))          # runs/soup/report/index.html
"""
