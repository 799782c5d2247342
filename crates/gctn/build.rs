//! Lets executables find libtorch where Cargo linked it from, with nothing exported.
//!
//! Link arguments reach only the package whose build script prints them. Every package with a program, a test or a
//! benchmark that ends up with tch therefore names this file: `build = "../../crates/gctn/build.rs"`.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed=LIBTORCH");
    // Programs in target/PROFILE, then tests and benchmarks in target/PROFILE/deps: holds when the tree is moved.
    println!("cargo::rustc-link-arg=-Wl,-rpath,$ORIGIN/../../.libtorch/lib");
    println!("cargo::rustc-link-arg=-Wl,-rpath,$ORIGIN/../../../.libtorch/lib");
    // Any other target folder, or another libtorch.
    if let Some(libtorch) = std::env::var_os("LIBTORCH") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{}/lib", libtorch.to_string_lossy());
    }
}
