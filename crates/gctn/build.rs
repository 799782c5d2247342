//! Lets the tests, benches and examples of this package find libtorch where torch-sys found it, with
//! nothing exported. Cargo applies link arguments only to the package that prints them, so every package
//! that makes an executable with tch in it names this file as its build script and depends on torch-sys directly.

fn main() {
    println!("cargo::rerun-if-env-changed=DEP_TCH_LIBTORCH_LIB");
    if let Ok(libraries) = std::env::var("DEP_TCH_LIBTORCH_LIB") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{libraries}");
    }
    // A tree that was moved after the build: target/release and target/release/deps. What computes on CUDA is looked for at run time.
    for folder in [".libtorch", ".libtorch-cuda"] {
        for up in ["../..", "../../.."] {
            println!("cargo::rustc-link-arg=-Wl,-rpath,$ORIGIN/{up}/{folder}/lib");
        }
    }
}
