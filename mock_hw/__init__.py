"""Stand-ins for hardware that answer like the real thing. Shipped: simulation is a product."""
