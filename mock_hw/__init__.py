"""Hardware and orchards that answer like the real ones, for development without either."""
