"""The learned segmenter. Only `network`, `loss`, `weights` and `segmenter` need torch."""

import os

# Threads of a team that wait must sleep, not spin: arm, bus and mapping want the cores. OpenMP
# reads this once, when torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# Activations on huge pages: Linux takes a tenth of the network's time to hand out small ones. torch
# reads this at its first allocation.
os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
