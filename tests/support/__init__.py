"""What tests and benchmarks share: memory of processes, interrupted runs, pages."""
