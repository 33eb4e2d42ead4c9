"""The catalogue's schema, step by step; `service.catalogue` runs what is missing at start."""
