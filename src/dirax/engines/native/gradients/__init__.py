"""Derivatives of a run: recording.py a run as a function of arrays, linearized_loop.py its loops of tangents and cotangents in
IR, tangents_on_host.py what runs them, differentiate.py the primitives of JAX that they are."""
