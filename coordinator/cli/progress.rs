//! Progress on a terminal: bars with an ETA. Silent when stderr is not a terminal.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::IsTerminal;
use std::time::Duration;

/// A bar over a known number of things, such as frames or tiles.
pub fn bar(what: &str, total: u64) -> ProgressBar {
    let style = ProgressStyle::with_template(
        "{prefix:>10} [{bar:32}] {pos}/{len} {per_sec} {msg} ETA {eta}",
    )
    .expect("the template is well formed")
    .progress_chars("=> ");
    let bar = ProgressBar::with_draw_target(Some(total), target()).with_style(style);
    bar.set_prefix(what.to_owned());
    bar.enable_steady_tick(Duration::from_millis(250));
    bar
}

fn target() -> ProgressDrawTarget {
    if std::io::stderr().is_terminal() {
        ProgressDrawTarget::stderr_with_hz(8)
    } else {
        ProgressDrawTarget::hidden()
    }
}
