//! The published network: four ResNet43_8s nets (Zeng et al., CoRL 2020; Seita et al., ICRA 2021).

use tch::{Kind, Tensor};

use super::Features;
use super::parameters::{Builder, Conv, Init, channels_last, upsample};
use crate::Resnet43;

/// 1x1, 3x3, 1x1 beside a shortcut, which is a convolution where size or channels change.
#[derive(Debug)]
struct Block {
    convs: [Conv; 3],
    shortcut: Option<Conv>,
    last_relu: bool,
}

impl Block {
    fn forward(&self, x: &Tensor) -> Tensor {
        let [first, second, third] = &self.convs;
        let y = third.forward(&second.forward(&first.forward(x).relu_()).relu_());
        let mut y = match &self.shortcut {
            Some(shortcut) => y + shortcut.forward(x),
            None => y + x,
        };
        if self.last_relu { y.relu_() } else { y }
    }
}

/// An hourglass of 57 convolutions in 16 residual blocks, stride 8 at its narrowest.
#[derive(Debug)]
struct Hourglass {
    stem: Conv,
    /// Blocks of a stage, and whether its output is doubled in size.
    stages: Vec<([Block; 2], bool)>,
}

impl Hourglass {
    fn new(name: &str, inputs: usize, outputs: usize, builder: &mut Builder) -> Self {
        let stem = builder.conv(&format!("{name}.stem"), [inputs, 64], 3, 1, Init::Glorot);
        let plan: [(usize, usize, usize, bool); 8] = [
            (64, 64, 1, false),
            (128, 128, 2, false),
            (256, 256, 2, false),
            (512, 512, 2, false),
            (256, 256, 1, true),
            (128, 128, 1, true),
            (64, 64, 1, true),
            (16, outputs, 1, false),
        ];
        let mut channels = 64;
        let mut stages = Vec::new();
        for (index, (filters, outputs, stride, doubled)) in plan.into_iter().enumerate() {
            let last_relu = index + 1 < plan.len();
            let mut block = |part: &str, inputs: usize, stride: usize, shortcut: bool| {
                let name = format!("{name}.stage{index}.{part}");
                let mut conv = |part: &str, shape, kernel, stride| {
                    builder.conv(
                        &format!("{name}.{part}"),
                        shape,
                        kernel,
                        stride,
                        Init::Glorot,
                    )
                };
                Block {
                    convs: [
                        conv("first", [inputs, filters], 1, stride),
                        conv("second", [filters, filters], 3, 1),
                        conv("third", [filters, outputs], 1, 1),
                    ],
                    shortcut: shortcut.then(|| conv("shortcut", [inputs, outputs], 1, stride)),
                    last_relu,
                }
            };
            let blocks = [
                block("a", channels, stride, true),
                block("b", outputs, 1, false),
            ];
            stages.push((blocks, doubled));
            channels = outputs;
        }
        Self { stem, stages }
    }

    fn forward(&self, x: &Tensor) -> Tensor {
        let mut x = self.stem.forward(x).relu_();
        for ([a, b], doubled) in &self.stages {
            x = b.forward(&a.forward(&x));
            if *doubled {
                x = upsample(&x);
            }
        }
        x
    }
}

/// Pick, query, key and goal net.
#[derive(Debug)]
pub(super) struct Resnet43Nets {
    pick: Hourglass,
    query: Hourglass,
    key: Hourglass,
    goal: Hourglass,
    crop: i64,
    goals: i64,
}

/// Mean and standard deviation of colour (as a fraction) and height (m) in Ravens.
const COLOR: (f64, f64) = (0.18877631, 0.07276466);
const HEIGHT_M: (f64, f64) = (0.00509261, 0.00903967);

/// From colour and height to RGB and three times the height, normalised.
fn normalise(x: &Tensor) -> Tensor {
    let color = (x.narrow(1, 0, 3) / 255.0 - COLOR.0) / COLOR.1;
    let height = (x.narrow(1, 3, 1) - HEIGHT_M.0) / HEIGHT_M.1;
    Tensor::cat(&[&color, &height, &height, &height], 1)
}

impl Resnet43Nets {
    pub fn new(config: &Resnet43, goals: usize, builder: &mut Builder) -> Self {
        let features = config.feature_channels;
        Self {
            pick: Hourglass::new("pick", 6 + 6 * goals, 1, builder),
            query: Hourglass::new("query", 6, features, builder),
            key: Hourglass::new("key", 6, features, builder),
            goal: Hourglass::new("goal", 6 * goals, features, builder),
            crop: config.crop_px as i64,
            goals: goals as i64,
        }
    }

    pub fn forward(&self, input: &Tensor, kind: Kind) -> Features {
        let (rows, cols) = (input.size()[2], input.size()[3]);
        // Padding comes before normalising: outside is black and at height 0.
        let padded = |x: &Tensor, [rows, cols]: [i64; 2]| {
            let x = normalise(&x.constant_pad_nd([cols, cols, rows, rows]));
            channels_last(&x.to_kind(kind))
        };
        // The observation, then the goals.
        let images: Vec<Tensor> = (0..=self.goals)
            .map(|index| input.narrow(1, 4 * index, 4))
            .collect();
        let stacked = |images: &[Tensor], margins: [i64; 2]| {
            let images: Vec<_> = images.iter().map(|image| padded(image, margins)).collect();
            channels_last(&Tensor::cat(&images, 1))
        };

        // The pick net reads a square.
        let edge = rows.max(cols);
        let margins = [(edge - rows) / 2, (edge - cols) / 2];
        let pick = self.pick.forward(&stacked(&images, margins)).squeeze_dim(1);
        let pick = pick.narrow(1, margins[0], rows).narrow(2, margins[1], cols);

        let margins = [self.crop / 2; 2];
        let observation = padded(&images[0], margins);
        let goal = self
            .goal
            .forward(&stacked(&images[1..], margins))
            .to_kind(input.kind());
        let query = self.query.forward(&observation).to_kind(input.kind()) * &goal;
        let key = self.key.forward(&observation).to_kind(input.kind()) * &goal;
        let area = (self.crop * self.crop) as f64;
        Features {
            pick: pick.to_kind(input.kind()),
            query,
            key,
            scale: Tensor::full([1], area.recip(), (input.kind(), input.device())),
            first: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_the_published_ones() {
        for (inputs, outputs, expected) in [(12, 1, 9_836_659), (6, 3, 9_833_433)] {
            let mut builder = Builder::empty(tch::Device::Cpu);
            Hourglass::new("net", inputs, outputs, &mut builder);
            let parameters = builder.finish();
            assert_eq!(parameters.len(), expected);
            assert_eq!(parameters.entries.len(), 2 * 57);
        }
    }
}
