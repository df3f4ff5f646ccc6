"""A powered chair in C MuJoCo with real wheel contacts: the truth side of tests that look for undeclared effects.

It shares no vehicle code with `whill_mjx`; only the file form of a dataset is borrowed. See README.md.
"""
