"""Events as WebAssembly: code generation, the running instance, and the state that moves in and out of it."""
