"""A UR controller at wire level: the unmodified vendor client libraries connect to it."""
