//! Every dependency has to come under a licence that deny.toml allows.
//!
//! cargo-deny does the same and more (advisories, bans, sources), but takes minutes to build: the CI of a host that has it
//! as an action runs it, this check runs everywhere.

use crate::command::{cargo, output, repository_root};
use anyhow::{Context as _, Result, bail};
use serde::Deserialize;

/// The part of deny.toml that is read here; cargo-deny reads all of it.
#[derive(Deserialize)]
struct Policy {
    licenses: Licenses,
}

#[derive(Deserialize)]
struct Licenses {
    /// SPDX names of the licences that we accept.
    allow: Vec<String>,
}

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

/// Checks the packages in Cargo.lock by the licences of deny.toml; the error lists every one that does not pass.
pub fn check() -> Result<()> {
    let path = repository_root().join("deny.toml");
    let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    let policy: Policy = toml::from_str(&text).with_context(|| path.display().to_string())?;
    let allowed = policy.licenses.allow;
    let json = output(cargo().args(["metadata", "--format-version", "1", "--locked"]))?;
    let metadata: Metadata =
        serde_json::from_str(&json).context("cannot read the output of cargo metadata")?;
    let refused: Vec<String> = metadata
        .packages
        .iter()
        .filter(|package| {
            !package
                .license
                .as_deref()
                .is_some_and(|license| is_met_by(&allowed, license))
        })
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
            "dependencies without a licence of deny.toml ({}):\n{}",
            allowed.join(", "),
            refused.join("\n")
        );
    }
    println!(
        "{} packages, all under permissive licences",
        metadata.packages.len()
    );
    Ok(())
}

/// Whether an SPDX expression can be met with the allowed licences alone; text that is not such an expression cannot.
fn is_met_by(allowed: &[String], expression: &str) -> bool {
    // Lax: old packages write "MIT/Apache-2.0".
    spdx::Expression::parse_mode(expression, spdx::ParseMode::LAX).is_ok_and(|parsed| {
        parsed.evaluate(|requirement| {
            requirement
                .license
                .id()
                .is_some_and(|id| allowed.iter().any(|name| name == id.name))
        })
    })
}

#[cfg(test)]
mod tests {
    fn is_permissive(expression: &str) -> bool {
        super::is_met_by(
            &["MIT", "Apache-2.0", "Unicode-3.0"].map(str::to_owned),
            expression,
        )
    }

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
