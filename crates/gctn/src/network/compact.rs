//! A shared U-Net with heads for pick logits, query and key features.

use tch::{Kind, Tensor};

use super::Features;
use super::parameters::{Builder, Conv, Init, upsample};
use crate::Compact;
use crate::input::Encoding;

/// Two 3x3 convolutions beside a shortcut; starts as the identity.
#[derive(Debug)]
struct Block {
    first: Conv,
    second: Conv,
}

impl Block {
    fn new(name: &str, channels: usize, builder: &mut Builder) -> Self {
        let shape = [channels, channels];
        Self {
            first: builder.conv(&format!("{name}.first"), shape, 3, 1, Init::FanIn),
            second: builder.conv(&format!("{name}.second"), shape, 3, 1, Init::Zero),
        }
    }

    fn forward(&self, x: &Tensor) -> Tensor {
        let y = self.second.forward(&self.first.forward(x).relu_());
        (y + x).relu_()
    }
}

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
    /// The 3x3 convolutions of all three heads.
    heads: Conv,
    pick: Conv,
    query: Conv,
    key: Conv,
    scale: Tensor,
    channels: i64,
    margin: i64,
}

impl CompactNet {
    pub fn new(config: &Compact, builder: &mut Builder) -> Self {
        let channels = config.channels;
        let levels = (0..channels.len())
            .map(|level| {
                let (inputs, kernel, name) = match level {
                    0 => (Encoding::Difference.channels(), 4, "stem".to_owned()),
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
        let (channels, features) = (channels[0], config.feature_channels);
        let correlated = config.window_cells as f64 * (features as f64).sqrt();
        Self {
            levels,
            rises,
            heads: builder.conv("heads", [channels, 3 * channels], 3, 1, Init::FanIn),
            pick: builder.conv("pick", [channels, 1], 1, 1, Init::FanIn),
            query: builder.conv("query", [channels, features], 1, 1, Init::FanIn),
            key: builder.conv("key", [channels, features], 1, 1, Init::FanIn),
            scale: builder.scalar("scale", correlated.recip()),
            channels: channels as i64,
            margin: config.window_cells as i64 / 2,
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
        let heads = self.heads.forward(&x).relu_();
        let head = |index: i64, conv: &Conv| {
            let x = heads.narrow(1, index * self.channels, self.channels);
            conv.forward(&x).to_kind(input.kind())
        };
        Features {
            pick: head(0, &self.pick).squeeze_dim(1),
            query: head(1, &self.query),
            key: head(2, &self.key).constant_pad_nd([self.margin; 4]),
            scale: self.scale.shallow_clone(),
        }
    }
}
