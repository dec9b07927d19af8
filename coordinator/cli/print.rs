//! Lines on standard output, for people and scripts.

use std::io::{ErrorKind, Write};

/// Prints a line, as `println!` does, which panics when whoever read it has gone.
macro_rules! print_line {
    () => { $crate::print::line(format_args!("")) };
    ($($text:tt)*) => { $crate::print::line(format_args!($($text)*)) };
}

/// Prints a line. Whoever read our output may have seen enough (`terrafarm ... | head`): the
/// work goes on, and the exit code says how it ended. Where a line cannot be written for
/// another reason, such as a full disk, the program says so and ends.
pub fn line(text: std::fmt::Arguments) {
    match writeln!(std::io::stdout(), "{text}") {
        Err(why) if why.kind() != ErrorKind::BrokenPipe => {
            eprintln!("terrafarm: cannot print: {why}");
            std::process::exit(2);
        }
        Ok(()) | Err(_) => {}
    }
}
