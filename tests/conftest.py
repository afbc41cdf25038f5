"""What all tests share."""

import os

import torch as th
from hypothesis import settings

# The suite shares its machine with others, and tiny networks gain nothing from more threads. Programs
# that tests start do the same: sums are rounded otherwise in several threads.
th.set_num_threads(1)
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Examples are the same in every run, however slow the machine is.
settings.register_profile("repeatable", derandomize=True, database=None, deadline=None)
settings.load_profile("repeatable")
