"""Recordings in other containers than MCAP: bags of ROS 1, and of ROS 2 in SQLite; imported to read one."""
