//! A shared U-Net.

use tch::{Kind, Tensor};

use super::Features;
use super::heads::{Block, Heads};
use super::parameters::{Builder, Conv, Init, upsample};
use crate::Compact;

/// One stride of the encoder.
#[derive(Debug)]
struct Level {
    down: Conv,
    blocks: Vec<Block>,
}

/// One stride of the decoder.
#[derive(Debug)]
struct Rise {
    lateral: Conv,
    block: Block,
}

#[derive(Debug)]
pub(super) struct CompactNet {
    levels: Vec<Level>,
    /// From the coarsest to the finest.
    rises: Vec<Rise>,
    heads: Heads,
}

impl CompactNet {
    pub fn new(config: &Compact, inputs: usize, builder: &mut Builder) -> Self {
        let channels = config.channels;
        let levels = (0..channels.len())
            .map(|level| {
                let (inputs, kernel, name) = match level {
                    0 => (inputs, 4, "stem".to_owned()),
                    _ => (channels[level - 1], 3, format!("level{level}.down")),
                };
                let down = builder.conv(&name, [inputs, channels[level]], kernel, 2, Init::FanIn);
                let block = |index| {
                    Block::new(
                        &format!("level{level}.block{index}"),
                        channels[level],
                        builder,
                    )
                };
                Level {
                    down,
                    blocks: (0..config.blocks[level]).map(block).collect(),
                }
            })
            .collect();
        let rises = (0..channels.len() - 1)
            .rev()
            .map(|level| {
                let shape = [channels[level + 1], channels[level]];
                Rise {
                    lateral: builder.conv(
                        &format!("rise{level}.lateral"),
                        shape,
                        1,
                        1,
                        Init::FanIn,
                    ),
                    block: Block::new(&format!("rise{level}.block"), channels[level], builder),
                }
            })
            .collect();
        Self {
            levels,
            rises,
            heads: Heads::new(
                channels[0],
                config.feature_channels,
                config.window_cells,
                builder,
            ),
        }
    }

    pub fn forward(&self, input: &Tensor, kind: Kind) -> Features {
        let mut x = input.to_kind(kind);
        let mut skips = Vec::new();
        for level in &self.levels {
            x = level.down.forward(&x).relu_();
            for block in &level.blocks {
                x = block.forward(&x);
            }
            skips.push(x.shallow_clone());
        }
        skips.pop();
        for (rise, skip) in self.rises.iter().zip(skips.iter().rev()) {
            x = upsample(&rise.lateral.forward(&x)) + skip;
            x = rise.block.forward(&x);
        }
        self.heads.forward(&x, input.kind())
    }
}
