"""A bench while it runs, as a source of batches that are on the disk before anything else is done with them.

``open_live(url)`` opens a serial port, a TCP server, standard input, a file that grows or the simulator::

    bytes -> [reader] -> samples -> [worker: recording, then a queue] -> whoever iterates

Reader and worker are threads of their own, so that neither a slow consumer nor a slow disk keeps bytes from being
taken in. See docs/live.md for the URLs and what a bench has to send.
"""

from kf_calib.sources.live.feed import Status
from kf_calib.sources.live.opening import files_of, open_live
from kf_calib.sources.live.source import LiveSource

__all__ = ["LiveSource", "Status", "files_of", "open_live"]
