//! Where libtorch computes.

use crate::{Device, Error, Precision};

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

impl Precision {
    /// What `device` computes in where this is asked for. On a processor without instructions for bf16 that is f32:
    /// there libtorch would emulate bf16, at an eighth of the speed of f32.
    pub fn on(self, device: Device) -> Self {
        match (self, device) {
            (Self::Bf16, Device::Cpu) if !processor_has_bf16() => Self::F32,
            _ => self,
        }
    }
}

impl std::fmt::Display for Precision {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(match self {
            Self::F32 => "f32",
            Self::Bf16 => "bf16",
        })
    }
}

/// Whether the processor multiplies in bf16: all that have AMX have this too.
fn processor_has_bf16() -> bool {
    #[cfg(target_arch = "x86_64")]
    return std::arch::is_x86_feature_detected!("avx512bf16");
    #[cfg(not(target_arch = "x86_64"))]
    return false;
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

    /// The kernel's word, against the compiler's.
    #[cfg(target_os = "linux")]
    #[test]
    fn bf16_is_computed_where_the_kernel_says_that_the_processor_has_it() {
        let info = std::fs::read_to_string("/proc/cpuinfo").unwrap();
        let has = info.split_whitespace().any(|flag| flag == "avx512_bf16");
        let expected = if has { Precision::Bf16 } else { Precision::F32 };
        assert_eq!(Precision::Bf16.on(Device::Cpu), expected);
        assert_eq!(Precision::Bf16.on(Device::Cuda), Precision::Bf16);
        assert_eq!(Precision::F32.on(Device::Cpu), Precision::F32);
    }

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
