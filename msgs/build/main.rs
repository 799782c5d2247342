//! Makes Rust types from the interface files of sctn_msgs and of vendor/.

mod definition;
mod rust;
mod type_hash;

use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    for path in ["build", "msg", "srv", "action", "vendor"] {
        println!("cargo::rerun-if-changed={path}");
    }
    match interfaces() {
        Ok(source) => std::fs::write(
            Path::new(&std::env::var("OUT_DIR")?).join("interfaces.rs"),
            source,
        )?,
        Err(mistake) => {
            println!("cargo::error={mistake}");
            std::process::exit(1);
        }
    }
    Ok(())
}

fn interfaces() -> Result<String, definition::Mistake> {
    let mut interfaces = definition::read_package(Path::new("."), "sctn_msgs")?;
    let unreadable = |error: std::io::Error| definition::Mistake {
        path: "vendor".into(),
        line: 0,
        what: error.to_string(),
    };
    let mut folders = Vec::new();
    for entry in std::fs::read_dir("vendor").map_err(unreadable)? {
        folders.push(entry.map_err(unreadable)?.path());
    }
    folders.sort();
    for folder in folders.iter().filter(|path| path.is_dir()) {
        let package = folder.file_name().unwrap_or_default().to_string_lossy();
        interfaces.extend(definition::read_package(folder, &package)?);
    }
    Ok(rust::generate(&definition::link(interfaces)?))
}
