//! The sctn command.

fn main() {}
