"""From nodes of the scalar program to LLVM IR: the text (`emitter`), which nodes where (`lower`), whole functions.

What an operation such as sin is in instructions, `dirax.engines.native.functions` says.
"""
