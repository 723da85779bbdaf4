"""Speed, with accuracy beside it: `python -m jaxsfm.bench.speed` (docs/performance.md)."""
