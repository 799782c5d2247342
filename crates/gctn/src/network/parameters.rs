//! Weights in one flat tensor, and convolutions that use them.

use rand::RngExt;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use std::cell::Cell;
use tch::{Device, Kind, Tensor};

/// How weights start.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Init {
    /// Uniform in +-1 / sqrt(fan in), weights and biases.
    FanIn,
    /// Uniform in +-sqrt(6 / (fan in + fan out)); biases 0 (Glorot and Bengio, 2010).
    Glorot,
    /// All 0.
    Zero,
}

/// Makes weights, in the order in which they are asked for.
pub(crate) struct Builder {
    rng: Option<ChaCha8Rng>,
    device: Device,
    kind: Kind,
    entries: Vec<(String, Tensor)>,
    /// Of each entry, whether it belongs to a convolution.
    of_convolutions: Vec<bool>,
}

impl Builder {
    /// Random weights.
    pub fn random(seed: u64, device: Device) -> Self {
        Self {
            rng: Some(ChaCha8Rng::seed_from_u64(seed)),
            device,
            kind: Kind::Float,
            entries: Vec::new(),
            of_convolutions: Vec::new(),
        }
    }

    /// Weights that are 0 and to be filled.
    pub fn empty(device: Device) -> Self {
        Self {
            rng: None,
            ..Self::random(0, device)
        }
    }

    /// The same in 64-bit floats.
    #[cfg(test)]
    pub fn double(self) -> Self {
        Self {
            kind: Kind::Double,
            ..self
        }
    }

    fn add(&mut self, name: String, tensor: Tensor, of_convolution: bool) -> Tensor {
        let tensor = tensor.to_kind(self.kind);
        self.of_convolutions.push(of_convolution);
        self.entries.push((name, tensor.shallow_clone()));
        tensor
    }

    fn uniform(&mut self, shape: &[i64], bound: f64) -> Tensor {
        match &mut self.rng {
            Some(rng) if bound > 0.0 => {
                let len = shape.iter().product::<i64>() as usize;
                let bound = bound as f32;
                let values: Vec<f32> = (0..len).map(|_| rng.random_range(-bound..bound)).collect();
                Tensor::from_slice(&values).view(shape)
            }
            _ => Tensor::zeros(shape, (Kind::Float, Device::Cpu)),
        }
    }

    /// A single number.
    pub fn scalar(&mut self, name: &str, value: f64) -> Tensor {
        let tensor = Tensor::full([1], value, (Kind::Float, Device::Cpu));
        self.add(name.into(), tensor, false)
    }

    /// A convolution with bias, padded so that at stride 1 the size stays.
    pub fn conv(
        &mut self,
        name: &str,
        [inputs, outputs]: [usize; 2],
        kernel: usize,
        stride: usize,
        init: Init,
    ) -> Conv {
        let area = kernel * kernel;
        let (fan_in, fan_out) = ((inputs * area) as f64, (outputs * area) as f64);
        let (weight_bound, bias_bound) = match init {
            Init::FanIn => (fan_in.sqrt().recip(), fan_in.sqrt().recip()),
            Init::Glorot => ((6.0 / (fan_in + fan_out)).sqrt(), 0.0),
            Init::Zero => (0.0, 0.0),
        };
        let [inputs, outputs, size] = [inputs, outputs, kernel].map(|size| size as i64);
        let weight = self.uniform(&[outputs, inputs, size, size], weight_bound);
        let bias = self.uniform(&[outputs], bias_bound);
        Conv {
            weight: self.add(format!("{name}.weight"), weight, true),
            bias: self.add(format!("{name}.bias"), bias, true),
            stride: stride as i64,
            // A 4x4 kernel of stride 2 is padded by 1, a 3x3 one too, a 1x1 one by 0.
            padding: (size - 1) / 2,
        }
    }

    /// Moves all weights into one flat tensor, of which they stay views.
    pub fn finish(self) -> Parameters {
        let flats: Vec<Tensor> = self
            .entries
            .iter()
            .map(|(_, tensor)| tensor.flatten(0, -1))
            .collect();
        let flat = Tensor::cat(&flats, 0).to_device(self.device);
        let mut offset = 0;
        let mut entries = self.entries;
        for (_, tensor) in &mut entries {
            let len = tensor.numel() as i64;
            let view = flat.narrow(0, offset, len).view(tensor.size().as_slice());
            tensor.set_data(&view);
            offset += len;
        }
        Parameters {
            entries,
            of_convolutions: self.of_convolutions,
            flat,
            cast: None,
        }
    }
}

/// Named weights, all views of one flat tensor.
#[derive(Debug)]
pub(crate) struct Parameters {
    /// In a fixed order.
    pub entries: Vec<(String, Tensor)>,
    of_convolutions: Vec<bool>,
    /// All of them, one after the other.
    pub flat: Tensor,
    /// The same in another kind, of which the weights of convolutions are views in a training that computes in it.
    cast: Option<Tensor>,
}

impl Parameters {
    /// How many numbers there are.
    pub fn len(&self) -> usize {
        self.flat.numel()
    }

    /// Converts the kernels of convolutions to `kind`, channels last in memory, so that no call of [`Conv::forward`] does. They are no
    /// longer views of the flat tensor: a network that is prepared cannot be trained.
    pub fn prepare(&self, kind: Kind) {
        let tensors = self.entries.iter().map(|(_, tensor)| tensor);
        for kernel in tensors.filter(|tensor| tensor.dim() == 4) {
            let prepared = channels_last(&kernel.to_kind(kind));
            kernel.shallow_clone().set_data(&prepared);
        }
    }

    /// From now on gradients reach the weights, those of convolutions in this kind: gives what they are to be taken along, one for each
    /// entry. Of another kind than the flat tensor's, convolutions use a copy of it, which is of now until [`Parameters::cast`].
    pub fn learn(&mut self, kind: Kind) -> Vec<Tensor> {
        if kind == self.flat.kind() {
            return self.require_gradients();
        }
        let cast = self.flat.to_kind(kind);
        let mut offset = 0;
        let used = self.entries.iter_mut().zip(&self.of_convolutions);
        let used = used.map(|((_, entry), of_convolution)| {
            let (len, size) = (entry.numel() as i64, entry.size());
            let view = |flat: &Tensor| flat.narrow(0, offset, len).view(size.as_slice());
            let mut used = entry.shallow_clone();
            if *of_convolution {
                // The entry stays a view of the flat tensor, and what the convolution holds becomes one of the copy.
                *entry = view(&self.flat);
                used.set_data(&view(&cast));
            }
            offset += len;
            used.set_requires_grad(true)
        });
        let used = used.collect();
        self.cast = Some(cast);
        used
    }

    /// Gives convolutions the weights as they are now, where they use a copy.
    pub fn cast(&self) {
        if let Some(cast) = &self.cast {
            tch::no_grad(|| cast.shallow_clone().copy_(&self.flat));
        }
    }

    /// Gradients along what [`Parameters::learn`] gave, as the flat tensor has the weights.
    pub fn flat_gradient(&self, gradients: &[Tensor]) -> Tensor {
        let flat = gradients.iter().map(|gradient| gradient.reshape([-1]));
        let flat: Vec<Tensor> = flat.collect();
        // Those of one kind at once, and not each for itself.
        let runs = flat.chunk_by(|one, next| one.kind() == next.kind());
        let runs: Vec<Tensor> = runs
            .map(|run| Tensor::cat(run, 0).to_kind(self.flat.kind()))
            .collect();
        match &*runs {
            [only] => only.shallow_clone(),
            runs => Tensor::cat(runs, 0),
        }
    }

    /// From now on gradients reach the weights.
    pub fn require_gradients(&self) -> Vec<Tensor> {
        let tensors = self.entries.iter();
        tensors
            .map(|(_, tensor)| tensor.shallow_clone().set_requires_grad(true))
            .collect()
    }
}

/// A convolution.
#[derive(Debug)]
pub(crate) struct Conv {
    weight: Tensor,
    bias: Tensor,
    stride: i64,
    padding: i64,
}

thread_local! {
    static MULTIPLICATIONS: Cell<u64> = const { Cell::new(0) };
}

/// How many multiplications the convolutions of this thread have made, forward.
pub(crate) fn multiplications() -> u64 {
    MULTIPLICATIONS.get()
}

impl Conv {
    /// Each number of the output is a sum over a kernel.
    fn counted(&self, output: Tensor) -> Tensor {
        let of_each = self.weight.numel() / self.weight.size()[0] as usize;
        let count = (output.numel() * of_each) as u64;
        MULTIPLICATIONS.set(MULTIPLICATIONS.get() + count);
        output
    }

    /// Convolves in the kind of `x`.
    pub fn forward(&self, x: &Tensor) -> Tensor {
        let [weight, bias] = [&self.weight, &self.bias].map(|tensor| tensor.to_kind(x.kind()));
        let (stride, padding) = ([self.stride; 2], [self.padding; 2]);
        self.counted(x.conv2d(&weight, Some(&bias), stride, padding, [1, 1], 1))
    }

    /// The same as [`Conv::forward`] for a 1x1 kernel at stride 1, as one product of matrices. `x` has its channels last in memory, and
    /// may be some channels of a larger tensor: it is not copied. The result has its channels last too.
    pub fn at_each_cell(&self, x: &Tensor) -> Tensor {
        let [weight, bias] = [&self.weight, &self.bias].map(|tensor| tensor.to_kind(x.kind()));
        let size = x.size();
        let rows = x.permute([0, 2, 3, 1]).reshape([-1, size[1]]);
        self.counted(rows.linear(&weight.flatten(1, -1), Some(&bias)))
            .view([size[0], size[2], size[3], -1])
            .permute([0, 3, 1, 2])
    }
}

/// The same numbers, channels last in memory, as convolutions like it.
pub(crate) fn channels_last(x: &Tensor) -> Tensor {
    x.permute([0, 2, 3, 1]).contiguous().permute([0, 3, 1, 2])
}

/// Twice as many rows and columns, bilinear between the centres of cells.
pub(crate) fn upsample(x: &Tensor) -> Tensor {
    let size = x.size();
    x.upsample_bilinear2d([2 * size[2], 2 * size[3]], false, None, None)
}
