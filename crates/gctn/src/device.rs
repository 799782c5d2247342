//! Where libtorch computes.

use crate::{Device, Error};

impl Device {
    /// libtorch's name of the device.
    pub(crate) fn open(self) -> Result<tch::Device, Error> {
        match self {
            Self::Cpu => Ok(tch::Device::Cpu),
            Self::Cuda if tch::Cuda::is_available() => Ok(tch::Device::Cuda(0)),
            Self::Cuda => Err(Error::NoCuda),
        }
    }
}
