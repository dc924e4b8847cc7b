"""Studies: a file names trainings, evaluations and tables; ``xreset study FILE`` makes those that are missing.

    file.py      what a study file may hold
    plan.py      the runs of a study, and its steps: reset banks, trainings, evaluations
    steps.py     what is left to do of a step, and the commands of xreset that do it
    launch.py    runs these commands, one after the other
    tables.py    tables of what the runs reach, next to the paper's figures (paper.py, paper.toml)
    report.py    the page: tables, and what makes them unfair or incomplete

A run is a folder that a command of ``xreset`` writes. Its files show which steps are done, so the same command
continues a study.
"""
