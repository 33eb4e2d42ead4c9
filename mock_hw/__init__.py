"""Hardware and orchards that answer like the real thing. Shipped: simulation is a product."""
