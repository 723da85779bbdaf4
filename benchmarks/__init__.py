"""Speed, with accuracy beside it: `python -m benchmarks` (docs/performance.md)."""
