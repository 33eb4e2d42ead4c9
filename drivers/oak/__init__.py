"""OAK-D cameras through depthai, which lives in a process of its own."""
