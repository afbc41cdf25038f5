"""What all tests share."""

import os

import torch as th

# The suite shares its machine with others, and tiny networks gain nothing from more threads. Programs
# that tests start do the same: sums are rounded otherwise in several threads.
th.set_num_threads(1)
os.environ.setdefault("OMP_NUM_THREADS", "1")
