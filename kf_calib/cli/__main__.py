"""``python -m kf_calib.cli``."""

from kf_calib.cli import main

main()
