"""The engine of sparse steps: arrays by XLA, linear equations by sparse elimination."""
