//! Where libtorch computes.

use crate::{Device, Error};

impl Device {
    /// libtorch's name of the device.
    pub(crate) fn open(self) -> Result<tch::Device, Error> {
        match self {
            Self::Cpu => Ok(tch::Device::Cpu),
            Self::Cuda => {
                let loaded = load_cuda();
                if loaded.is_ok() && tch::Cuda::is_available() {
                    return Ok(tch::Device::Cuda(0));
                }
                let problem = loaded.err();
                Err(Error::NoCuda {
                    problem: problem.unwrap_or_else(|| "there is no card".into()),
                })
            }
        }
    }
}

/// Loads the part of libtorch that computes on CUDA, which registers itself. Executables are linked to the part
/// for processors only, and find this one where the loader looks: in LD_LIBRARY_PATH, which then names the
/// whole libtorch of the same version.
#[cfg(target_os = "linux")]
fn load_cuda() -> Result<(), String> {
    use libloading::os::unix::{Library, RTLD_GLOBAL, RTLD_NOW};
    use std::sync::OnceLock;
    static LOADED: OnceLock<Result<(), String>> = OnceLock::new();
    let load = || {
        // SAFETY: loading runs the constructors of the library. They are those of libtorch itself, which
        // register operators with the libtorch that is loaded already, as in every program linked to both; it
        // happens once, and the library stays loaded until the end.
        #[allow(unsafe_code)]
        let library = unsafe { Library::open(Some("libtorch_cuda.so"), RTLD_NOW | RTLD_GLOBAL) };
        let library = library.map_err(|error| {
            let source = std::error::Error::source(&error).map(ToString::to_string);
            format!("libtorch_cuda.so: {}", source.unwrap_or(error.to_string()))
        })?;
        std::mem::forget(library);
        Ok(())
    };
    LOADED.get_or_init(load).clone()
}

#[cfg(not(target_os = "linux"))]
fn load_cuda() -> Result<(), String> {
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_cuda_the_error_says_what_was_looked_for() {
        match Device::Cuda.open() {
            Ok(device) => assert_eq!(device, tch::Device::Cuda(0)),
            Err(error) => {
                let error = error.to_string();
                let told = error.contains("libtorch_cuda.so") || error.contains("no card");
                assert!(told, "{error}");
            }
        }
    }
}
