"""What all tests share."""

import torch as th

# The suite shares its machine with others, and tiny networks gain nothing from more threads.
th.set_num_threads(1)
