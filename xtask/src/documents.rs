//! Relative links of the Markdown files lead to files of the repository.

use crate::command::{command, output, repository_root};
use anyhow::Result;
use std::path::Path;

/// `file: link` for each relative link that leads nowhere.
pub fn broken_links() -> Result<Vec<String>> {
    let root = repository_root();
    let listed = output(command("git").args(["ls-files", "-co", "--exclude-standard", "*.md"]))?;
    let mut broken = Vec::new();
    for file in listed
        .lines()
        .filter(|file| !file.starts_with("third_party/"))
    {
        let path = root.join(file);
        // Deleted, and not committed yet.
        let Ok(text) = std::fs::read_to_string(&path) else {
            continue;
        };
        let folder = path.parent().unwrap_or(Path::new(""));
        broken.extend(
            links(&text)
                .filter(|link| !folder.join(link).exists())
                .map(|link| format!("{file}: {link}")),
        );
    }
    Ok(broken)
}

/// Targets of `[text](target)` without anchors; addresses are left out.
fn links(text: &str) -> impl Iterator<Item = &str> {
    text.split("](").skip(1).filter_map(|rest| {
        let target = rest.split(')').next()?;
        let target = target.split('#').next()?.trim();
        (!target.is_empty() && !target.contains("://")).then_some(target)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_relative_link_of_the_documents_leads_to_a_file() {
        assert_eq!(broken_links().unwrap(), Vec::<String>::new());
    }

    #[test]
    fn anchors_and_addresses_are_left_out() {
        let text = "[a](x.md#part) [b](#here) [c](https://example.org) ![](d.png)";
        assert_eq!(links(text).collect::<Vec<_>>(), ["x.md", "d.png"]);
    }
}
