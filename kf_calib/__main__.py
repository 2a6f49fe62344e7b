"""``python -m kf_calib``."""

from kf_calib.cli import main

if __name__ == "__main__":
    main()
