"""What the nodes of ROS 1 and of ROS 2 have in common; nothing here knows either."""
