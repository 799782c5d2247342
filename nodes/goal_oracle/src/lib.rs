//! Node that holds the demonstration sequence and latches the next-step goal.
