"""HTTP: translates requests into calls of `service.scans` and the rig, and answers into JSON."""
