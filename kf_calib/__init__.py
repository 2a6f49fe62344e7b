"""kf_calib: sequential Kalman-filter calibration of accelerometers on a stationary gimballed bench."""
