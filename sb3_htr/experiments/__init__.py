"""The figures under ``results/`` as code: ``sb3-htr experiment NAME`` repeats one of them."""
