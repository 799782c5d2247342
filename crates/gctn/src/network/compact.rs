//! A shared U-Net.

use tch::{Kind, Tensor};

use super::Features;
use super::encoder::Encoder;
use super::heads::{Block, Heads};
use super::parameters::{Builder, Conv, Init, upsample};
use crate::Compact;

/// One stride of the decoder.
#[derive(Debug)]
struct Rise {
    lateral: Conv,
    block: Block,
}

#[derive(Debug)]
pub(super) struct CompactNet {
    encoder: Encoder,
    /// From the coarsest to the finest.
    rises: Vec<Rise>,
    heads: Heads,
}

impl CompactNet {
    pub fn new(config: &Compact, inputs: usize, builder: &mut Builder) -> Self {
        let channels = config.channels;
        let encoder = Encoder::new(inputs, &channels, &config.blocks, builder);
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
            encoder,
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
        let (mut x, skips) = self.encoder.forward(&input.to_kind(kind));
        for (rise, skip) in self.rises.iter().zip(skips.iter().rev()) {
            x = upsample(&rise.lateral.forward(&x)) + skip;
            x = rise.block.forward(&x);
        }
        self.heads.forward(&x, input.kind())
    }
}
