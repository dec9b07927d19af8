//! `terrafarm token`: the secret that lets a PC join a farm.

use crate::{Outcome, args, secret};
use anyhow::{Context, bail};
use std::io::BufRead;
use terrafarm_coordinator::api::WebKey;
use terrafarm_wire::link::FarmToken;

/// Longest line that is read, bytes.
const LINE_BYTES_MAX: u64 = 4096;

/// Prints the token of this PC, or takes one.
pub fn run(args: &args::serve::Token) -> anyhow::Result<Outcome> {
    let path = match &args.token_file {
        Some(path) => path.clone(),
        None => secret::default_file()?,
    };
    if !args.enter {
        let token = match secret::read(&path)? {
            Some(token) => token,
            None => secret::make(&path)?,
        };
        if args.web {
            print_line!("{}", WebKey::of(&token).as_text());
        } else {
            print_line!("{}", token.to_text());
        }
        return Ok(Outcome::Done);
    }
    let token = enter()?;
    match secret::read(&path)? {
        Some(there) if there.to_text() == token.to_text() => {}
        Some(_) => bail!(
            "{} holds the token of another farm; move it away first, or name another --token-file",
            path.display()
        ),
        None => secret::keep(&path, &token)?,
    }
    print_line!("{}: workers and renders of this user find the farm token there", path.display());
    Ok(Outcome::Done)
}

fn enter() -> anyhow::Result<FarmToken> {
    use std::io::{IsTerminal, Read};
    if std::io::stdin().is_terminal() {
        eprint!("farm token: ");
    }
    let mut line = String::new();
    let mut stdin = std::io::stdin().lock().take(LINE_BYTES_MAX);
    stdin.read_line(&mut line).context("cannot read the farm token from standard input")?;
    Ok(line.trim().parse()?)
}
