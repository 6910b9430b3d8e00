"""Run events as WebAssembly."""
