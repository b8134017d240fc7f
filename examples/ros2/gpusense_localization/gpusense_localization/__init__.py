"""A thin node for ROS 2 around gpusense's particle filter."""
