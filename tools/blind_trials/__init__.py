"""Blind trial: recordings with a hidden effect are judged by the program, and its answers by the truth.

From a trial to its figure: ``schedule`` lists the trials (``Task``), ``workers`` plays them (``plays``), each gives an
``Outcome``, ``figures`` counts outcomes into shares with limits, and ``report`` shows them.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is imported: one thread for each process is enough
