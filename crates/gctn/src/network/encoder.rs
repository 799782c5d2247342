//! The half of a U-Net that goes down.

use tch::Tensor;

use super::heads::Block;
use super::parameters::{Builder, Conv, Init};

/// A convolution of stride 2 and residual blocks, over and over.
#[derive(Debug)]
pub(crate) struct Encoder {
    levels: Vec<Level>,
}

#[derive(Debug)]
struct Level {
    down: Conv,
    blocks: Vec<Block>,
}

impl Encoder {
    /// With these channels and numbers of residual blocks at strides 2, 4, 8 and so on.
    pub fn new(inputs: usize, channels: &[usize], blocks: &[usize], builder: &mut Builder) -> Self {
        let levels = channels.iter().zip(blocks).enumerate();
        let levels = levels.map(|(level, (&outputs, &blocks))| {
            let (inputs, kernel, name) = match level {
                0 => (inputs, 4, "stem".to_owned()),
                _ => (channels[level - 1], 3, format!("level{level}.down")),
            };
            let down = builder.conv(&name, [inputs, outputs], kernel, 2, Init::FanIn);
            let block = |index| Block::new(&format!("level{level}.block{index}"), outputs, builder);
            Level {
                down,
                blocks: (0..blocks).map(block).collect(),
            }
        });
        Self {
            levels: levels.collect(),
        }
    }

    /// What comes out of the last level, and of those before it.
    pub fn forward(&self, input: &Tensor) -> (Tensor, Vec<Tensor>) {
        let mut x = input.shallow_clone();
        let mut outputs = Vec::with_capacity(self.levels.len());
        for level in &self.levels {
            x = level.down.forward(&x).relu_();
            for block in &level.blocks {
                x = block.forward(&x);
            }
            outputs.push(x.shallow_clone());
        }
        outputs.pop();
        (x, outputs)
    }
}
