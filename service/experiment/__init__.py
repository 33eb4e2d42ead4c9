"""The paper's experiment (section IV) on a simulated orchard, resumable, as one table."""
