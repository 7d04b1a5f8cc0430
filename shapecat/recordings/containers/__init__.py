"""Containers of messages: MCAP files, ROS 1 bags, ROS 2 bags."""
