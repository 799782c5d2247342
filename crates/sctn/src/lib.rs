//! Sequence-conditioned learning: data set, weighted sampling, training, evaluation.
