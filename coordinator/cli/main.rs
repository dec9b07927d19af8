//! The program `terrafarm`: reads what the user typed, calls the parts, prints.
//!
//! `args` mirrors the command line; every other module carries out one command. Nothing
//! here decides who renders what, and nothing here touches a pixel.
//!
//! Exit codes: 0 done, 1 finished with failed frames or a bench that
//! found a method wrong, 2 could not run.

#[macro_use]
mod print;

mod args;
mod commands;
mod farm;
mod files;
mod identity;
mod input;
mod lan;
mod notify;
mod place;
mod progress;
mod secret;
mod shot;

use clap::Parser;
use std::io::IsTerminal;
use std::process::ExitCode;

/// How a command that ran to its end ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// Everything was done.
    Done,
    /// The command finished, but some frames failed.
    FailedFrames,
    /// A bench ran to its end and found a promise broken.
    BrokenPromise,
}

fn main() -> ExitCode {
    let args = match args::Args::try_parse() {
        Ok(args) => args,
        Err(refusal) => {
            // Help and version are not errors; clap prints both kinds where they belong.
            let code = if refusal.use_stderr() { 2 } else { 0 };
            let _ = refusal.print();
            return ExitCode::from(code);
        }
    };
    log_to_stderr(args.verbose);
    match commands::run(args.command) {
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::FailedFrames | Outcome::BrokenPromise) => ExitCode::from(1),
        Err(error) if is_broken_pipe(&error) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("terrafarm: {}", one_line(&error));
            ExitCode::from(2)
        }
    }
}

/// What went wrong and why, on one line. Many errors of libraries tell their cause
/// themselves; it is not said twice.
fn one_line(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if text.is_empty() {
            text = cause;
        } else if !text.contains(&cause) {
            text.push_str(": ");
            text.push_str(&cause);
        }
    }
    text
}

/// Whoever read our output has seen enough (`terrafarm ... | head`).
fn is_broken_pipe(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| {
        cause
            .downcast_ref::<std::io::Error>()
            .is_some_and(|io| io.kind() == std::io::ErrorKind::BrokenPipe)
    })
}

fn log_to_stderr(verbose: u8) {
    let level = match verbose {
        0 => tracing::Level::WARN,
        1 => tracing::Level::INFO,
        _ => tracing::Level::DEBUG,
    };
    // Colours are for people: a log that goes to a file or another program has none.
    let ansi = std::io::stderr().is_terminal();
    let log = tracing_subscriber::fmt().with_max_level(level).with_writer(std::io::stderr);
    log.with_ansi(ansi).init();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn causes_stand_on_one_line_and_none_twice() {
        let io = std::io::Error::other("disk on fire");
        let error = anyhow::Error::new(io).context("cannot write x: disk on fire");
        assert_eq!(one_line(&error.context("no store")), "no store: cannot write x: disk on fire");
    }
}
