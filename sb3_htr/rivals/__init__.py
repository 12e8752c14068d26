"""What HTR is compared with, beside PEARL: agents of other libraries, on the same task families and by the same evaluation.

Each is in a module of its own, because they need different packages: :mod:`sb3_htr.rivals.rl2` needs sb3-contrib.
"""
