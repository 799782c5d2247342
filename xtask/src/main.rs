//! Set-up, demonstration run and tests of the whole repository.

fn main() {}
