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

/// A U-Net from full to half resolution.
#[derive(Debug)]
pub(super) struct UNet {
    encoder: Encoder,
    /// From the coarsest to the finest.
    rises: Vec<Rise>,
}

impl UNet {
    /// With these channels and residual blocks at strides 2, 4, 8 and 16.
    pub fn new(
        inputs: usize,
        channels: [usize; 4],
        blocks: &[usize; 4],
        builder: &mut Builder,
    ) -> Self {
        let encoder = Encoder::new(inputs, &channels, blocks, builder);
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
        Self { encoder, rises }
    }

    /// As many channels as at stride 2.
    pub fn forward(&self, input: &Tensor) -> Tensor {
        let (mut x, skips) = self.encoder.forward(input);
        for (rise, skip) in self.rises.iter().zip(skips.iter().rev()) {
            x = upsample(&rise.lateral.at_each_cell(&x));
            x += skip;
            x = rise.block.forward(&x);
        }
        x
    }
}

#[derive(Debug)]
pub(super) struct CompactNet {
    trunk: UNet,
    heads: Heads,
}

impl CompactNet {
    pub fn new(config: &Compact, inputs: usize, builder: &mut Builder) -> Self {
        Self {
            trunk: UNet::new(inputs, config.channels, &config.blocks, builder),
            heads: Heads::new(
                config.channels[0],
                config.feature_channels,
                config.window_cells,
                builder,
            ),
        }
    }

    pub fn forward(&self, input: &Tensor, kind: Kind) -> Features {
        let x = self.trunk.forward(&input.to_kind(kind));
        self.heads.forward(&x, input.kind())
    }
}
