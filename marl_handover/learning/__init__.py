"""Training the supervisor: algorithms, hindsight replay, trainer, evaluation on the batched rules."""
