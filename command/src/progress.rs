//! Progress of long work, on standard error.

use indicatif::{ProgressBar, ProgressStyle};

/// A bar that counts to `len` with an estimate of the time left.
pub fn bar(len: u64, what: &'static str) -> ProgressBar {
    let style = ProgressStyle::with_template(
        "{prefix} {bar:30} {pos}/{len}  {elapsed} gone, {eta} left  {msg}",
    );
    ProgressBar::new(len)
        .with_style(style.expect("the template is valid"))
        .with_prefix(what)
}
