"""The figures under ``results/`` as code: each module is one experiment, ``python -m sb3_htr.experiments.NAME`` repeats it."""
