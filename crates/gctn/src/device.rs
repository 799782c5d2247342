//! Where libtorch computes.

use std::fmt;
use std::str::FromStr;
use std::time::Instant;

use tch::{Kind, Tensor};

use crate::network::channels_last;
use crate::{Device, Error, Precision};

impl Device {
    /// libtorch's name of the device.
    pub(crate) fn open(self) -> Result<tch::Device, Error> {
        match self {
            Self::Cpu => Ok(tch::Device::Cpu),
            Self::Cuda(number) => {
                let refused = |problem| Error::NoCuda {
                    device: self,
                    problem,
                };
                load_cuda().map_err(refused)?;
                if !tch::Cuda::is_available() {
                    return Err(refused("there is no card".into()));
                }
                let count = tch::Cuda::device_count();
                if number as i64 >= count {
                    return Err(refused(format!("there are {count} cards, counted from 0")));
                }
                // The sizes of a training are always the same: the fastest convolution for each is looked for once.
                tch::Cuda::cudnn_set_benchmark(true);
                Ok(tch::Device::Cuda(number))
            }
        }
    }

    /// Fails where it cannot be used, and says why.
    pub fn check(self) -> Result<(), Error> {
        self.open().map(drop)
    }
}

/// What a device computes at best, in 10^12 operations a second (a multiplication and an addition are two): a convolution of 3x3 over
/// 256 channels at 64x64 cells of 8 samples. On CUDA convolutions of 32-bit floats are rounded to TF32 where the card has it, unless
/// the environment says NVIDIA_TF32_OVERRIDE=0.
pub fn convolution_tflops(device: Device, precision: Precision) -> Result<f64, Error> {
    const SAMPLES: i64 = 8;
    const CHANNELS: i64 = 256;
    const EDGE: i64 = 64;
    crate::apply_threads();
    let device = device.open()?;
    let kind = match precision {
        Precision::F32 => Kind::Float,
        Precision::Bf16 => Kind::BFloat16,
    };
    let numbers = |size: [i64; 4]| {
        let numbers = Tensor::ones(size, (kind, device)) / 64.0;
        channels_last(&numbers)
    };
    let (x, kernel) = (
        numbers([SAMPLES, CHANNELS, EDGE, EDGE]),
        numbers([CHANNELS, CHANNELS, 3, 3]),
    );
    let run = |count: u32| -> Result<f64, Error> {
        let begun = Instant::now();
        let mut last = 0.0;
        for index in 0..count {
            let no_bias = None::<&Tensor>;
            let y = x.f_conv2d(&kernel, no_bias, [1, 1], [1, 1], [1, 1], 1)?;
            if index + 1 == count {
                // Waits for all of them.
                last = y.f_double_value(&[0, 0, 0, 0])?;
            }
        }
        let seconds = begun.elapsed().as_secs_f64();
        match last.is_finite() {
            true => Ok(seconds / f64::from(count)),
            false => Err(Error::NotFinite {
                what: "a convolution of ones",
                step: None,
            }),
        }
    };
    let once = tch::no_grad(|| run(2).and_then(|_| run(1)))?;
    // For about a third of a second.
    let seconds = tch::no_grad(|| run((0.3 / once).clamp(1.0, 10_000.0) as u32))?;
    let operations = 2 * 9 * SAMPLES * CHANNELS * CHANNELS * EDGE * EDGE;
    Ok(operations as f64 * 1e-12 / seconds)
}

impl fmt::Display for Device {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cpu => formatter.write_str("cpu"),
            Self::Cuda(0) => formatter.write_str("cuda"),
            Self::Cuda(number) => write!(formatter, "cuda:{number}"),
        }
    }
}

impl FromStr for Device {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self, Error> {
        // A number as it is written by us: `cuda:+1` and `cuda:01` are typing errors.
        let number = |text: &str| {
            let number = text.parse::<u16>().ok()?;
            (number.to_string() == text).then_some(usize::from(number))
        };
        let device = match text {
            "cpu" => Some(Self::Cpu),
            "cuda" => Some(Self::Cuda(0)),
            _ => text.strip_prefix("cuda:").and_then(number).map(Self::Cuda),
        };
        device.ok_or_else(|| Error::Config {
            what: "device",
            actual: text.to_owned(),
            expected: "cpu, cuda or cuda:N",
        })
    }
}

impl TryFrom<String> for Device {
    type Error = Error;

    fn try_from(text: String) -> Result<Self, Error> {
        text.parse()
    }
}

impl From<Device> for String {
    fn from(device: Device) -> Self {
        device.to_string()
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

impl fmt::Display for Precision {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
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
            let reason = source.unwrap_or(error.to_string());
            match reason.starts_with("libtorch_cuda.so") {
                true => reason,
                false => format!("libtorch_cuda.so: {reason}"),
            }
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
        assert_eq!(Precision::Bf16.on(Device::Cuda(0)), Precision::Bf16);
        assert_eq!(Precision::F32.on(Device::Cpu), Precision::F32);
    }

    #[test]
    fn without_cuda_the_error_says_what_was_asked_for_and_looked_for() {
        for (number, name) in [(0, "cuda"), (9, "cuda:9")] {
            match Device::Cuda(number).open() {
                Ok(device) => assert_eq!(device, tch::Device::Cuda(number)),
                Err(error) => {
                    let error = error.to_string();
                    assert!(error.starts_with(&format!("device {name} ")), "{error}");
                    let reasons = ["libtorch_cuda.so", "no card", "cards, counted from 0"];
                    assert!(
                        reasons.iter().any(|reason| error.contains(reason)),
                        "{error}"
                    );
                }
            }
        }
    }

    #[test]
    fn a_device_is_written_as_it_is_read_and_others_are_refused_by_name() {
        for (text, device) in [
            ("cpu", Device::Cpu),
            ("cuda", Device::Cuda(0)),
            ("cuda:3", Device::Cuda(3)),
        ] {
            assert_eq!(text.parse::<Device>().unwrap(), device);
            assert_eq!(device.to_string(), text);
            let json = serde_json::to_string(&device).unwrap();
            assert_eq!(json, format!("\"{text}\""));
            assert_eq!(serde_json::from_str::<Device>(&json).unwrap(), device);
        }
        assert_eq!("cuda:0".parse::<Device>().unwrap(), Device::Cuda(0));
        for wrong in [
            "", "gpu", "CUDA", "cuda:", "cuda:-1", "cuda:01", "cuda:x", "cuda1",
        ] {
            let error = wrong.parse::<Device>().unwrap_err().to_string();
            assert_eq!(
                error,
                format!("device is {wrong}, expected cpu, cuda or cuda:N")
            );
        }
    }
}
