#![allow(missing_docs)]
#[allow(dead_code)]
mod input;

fn main() {}
