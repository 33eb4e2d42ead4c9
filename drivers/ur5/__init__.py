"""A Universal Robots UR5 through ur-rtde, kept in a process of its own."""
