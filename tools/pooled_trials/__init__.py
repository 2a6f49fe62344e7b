"""Blind trial of the pooled diagnosis: campaigns of many runs, and what the diagnosis says of them.

``campaigns`` hides an effect in the factors of runs, ``trial`` lets the diagnosis judge them and compares it with the
truth, ``report`` counts, and ``command`` is the command line.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is imported: one thread for each process is enough
