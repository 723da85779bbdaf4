"""A resumable piece of work in a folder: reconstruct, localize, extend."""
