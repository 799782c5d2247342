//! Every dependency has to come under a permissive licence.

use crate::command::{cargo, output};
use anyhow::{Context as _, Result, bail};
use serde::Deserialize;

/// SPDX names of the licences that we accept.
const PERMISSIVE: [&str; 14] = [
    "0BSD",
    "Apache-2.0",
    "BSD-2-Clause",
    "BSD-3-Clause",
    "BSL-1.0",
    "CC0-1.0",
    "ISC",
    "MIT",
    "MIT-0",
    "NCSA",
    "Unicode-3.0",
    "Unicode-DFS-2016",
    "Unlicense",
    "Zlib",
];

#[derive(Deserialize)]
struct Metadata {
    packages: Vec<Package>,
}

#[derive(Deserialize)]
struct Package {
    name: String,
    version: String,
    license: Option<String>,
}

/// Checks the packages in Cargo.lock; the error lists every one that does not pass.
pub fn check() -> Result<()> {
    let json = output(cargo().args(["metadata", "--format-version", "1", "--locked"]))?;
    let metadata: Metadata =
        serde_json::from_str(&json).context("cannot read the output of cargo metadata")?;
    let refused: Vec<String> = metadata
        .packages
        .iter()
        .filter(|package| !package.license.as_deref().is_some_and(is_permissive))
        .map(|package| {
            format!(
                "{} {}: {}",
                package.name,
                package.version,
                package.license.as_deref().unwrap_or("names no licence")
            )
        })
        .collect();
    if !refused.is_empty() {
        bail!(
            "dependencies without a permissive licence (one of {}):\n{}",
            PERMISSIVE.join(", "),
            refused.join("\n")
        );
    }
    println!(
        "{} packages, all under permissive licences",
        metadata.packages.len()
    );
    Ok(())
}

/// Whether an SPDX expression can be met with permissive licences alone; text that is no such expression cannot.
fn is_permissive(expression: &str) -> bool {
    // Lax: old packages write "MIT/Apache-2.0".
    spdx::Expression::parse_mode(expression, spdx::ParseMode::LAX).is_ok_and(|parsed| {
        parsed.evaluate(|requirement| {
            requirement
                .license
                .id()
                .is_some_and(|id| PERMISSIVE.contains(&id.name))
        })
    })
}

#[cfg(test)]
mod tests {
    use super::is_permissive;

    #[test]
    fn one_permissive_choice_is_enough() {
        assert!(is_permissive("MIT"));
        assert!(is_permissive("MIT/Apache-2.0"));
        assert!(is_permissive("GPL-3.0-only OR MIT"));
        assert!(is_permissive("(MIT OR Apache-2.0) AND Unicode-3.0"));
        assert!(is_permissive("Apache-2.0 WITH LLVM-exception"));
    }

    #[test]
    fn copyleft_and_unknown_licences_are_refused() {
        assert!(!is_permissive("GPL-3.0-only"));
        assert!(!is_permissive("MIT AND GPL-3.0-only"));
        assert!(!is_permissive("MPL-2.0"));
        assert!(!is_permissive("see the file LICENSE"));
        assert!(!is_permissive(""));
    }
}
