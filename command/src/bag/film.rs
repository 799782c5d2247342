//! `sctn bag film`: a recorded run as a moving picture.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use bags::BagReader;
use clap::Args;
use heightmap::picture::{self, RgbImage};
use image::codecs::gif::{GifEncoder, Repeat};
use image::imageops::{self, FilterType};
use image::{Delay, DynamicImage, Frame, Rgb};
use msgs::{Interface as _, convert, sctn_msgs};
use step_protocol::{Goal, Observation, Proposal, StepOutcome, StepResult};

/// How long a proposal is shown, its result, and the workspace at the end (ms).
const PROPOSAL_MS: u32 = 900;
const RESULT_MS: u32 = 500;
const END_MS: u32 = 2500;
/// Width of the border that shows the result (pixels).
const BORDER_PX: u32 = 4;
const WAITING: Rgb<u8> = Rgb([90, 90, 90]);
const PLACED: Rgb<u8> = Rgb([40, 170, 70]);
const FAILED: Rgb<u8> = Rgb([205, 50, 45]);

/// Arguments of `sctn bag film`.
#[derive(Args)]
pub struct Film {
    /// Folder of a bag of a recorded run, or a single .mcap or .db3 file
    bag: PathBuf,
    /// GIF to write
    #[arg(long)]
    out: PathBuf,
}

impl Film {
    pub fn run(self) -> Result<ExitCode> {
        let bag = BagReader::open(&self.bag)?;
        for type_name in [
            sctn_msgs::Heightmap::TYPE_NAME,
            sctn_msgs::PickPlace::TYPE_NAME,
        ] {
            let mut topics = bag.topics().iter();
            ensure!(
                topics.any(|topic| topic.type_name == type_name && topic.message_count > 0),
                "{}: no message of type {type_name}: expected the bag of a recorded run",
                self.bag.display()
            );
        }
        let mut film = Writer::create(&self.out)?;
        let mut run = Run::default();
        for message in bag.messages_between(&[], Duration::ZERO, Duration::MAX) {
            let message = message?;
            let topic = message.topic.name.clone();
            match message.topic.type_name.as_str() {
                sctn_msgs::Heightmap::TYPE_NAME => {
                    let seen = convert::observation_from_msg(message.decode()?);
                    run.seen = Some(seen.with_context(|| topic)?);
                }
                sctn_msgs::Goal::TYPE_NAME => {
                    let goal = convert::goal_from_msg(message.decode()?).with_context(|| topic)?;
                    run.goal = Some(goal);
                }
                sctn_msgs::PickPlace::TYPE_NAME => {
                    let proposal = message.decode()?;
                    let proposal = convert::proposal_from_msg(&proposal).with_context(|| topic)?;
                    run.on_proposal(proposal, &mut film)?;
                }
                sctn_msgs::StepResult::TYPE_NAME => {
                    let result = convert::result_from_msg(&message.decode()?);
                    run.on_result(&result.with_context(|| topic)?, &mut film)?;
                }
                _ => {}
            }
        }
        run.end(&mut film)?;
        println!("{}: {} frames", self.out.display(), film.frames);
        Ok(ExitCode::SUCCESS)
    }
}

/// What was last heard of the run.
#[derive(Default)]
struct Run {
    seen: Option<Observation>,
    goal: Option<Goal>,
    /// The last proposal, and the picture that shows it.
    shown: Option<(Proposal, RgbImage)>,
}

impl Run {
    /// The workspace with pick and place marked, beside the goal.
    fn on_proposal(&mut self, proposal: Proposal, film: &mut Writer) -> Result<()> {
        let is_repeated = |(shown, _): &(Proposal, RgbImage)| shown.id == proposal.id;
        let Some(seen) = &self.seen else {
            return Ok(());
        };
        if self.shown.as_ref().is_some_and(is_repeated) {
            return Ok(());
        }
        let mut workspace = picture::colors(&seen.heightmap);
        let (pick, place) = (&proposal.action.pick, &proposal.action.place);
        picture::mark(&mut workspace, &seen.heightmap.workspace, pick, place);
        let picture = self.beside_goal(workspace);
        film.shoot(&picture, WAITING, PROPOSAL_MS)?;
        self.shown = Some((proposal, picture));
        Ok(())
    }

    /// The same with a border in the colour of the result; refusals of confirmations are left out.
    fn on_result(&mut self, result: &StepResult, film: &mut Writer) -> Result<()> {
        let Some((proposal, picture)) = &self.shown else {
            return Ok(());
        };
        if proposal.id != result.proposal_id || result.outcome == StepOutcome::Refused {
            return Ok(());
        }
        let color = match result.outcome {
            StepOutcome::Placed => PLACED,
            _ => FAILED,
        };
        film.shoot(picture, color, RESULT_MS)
    }

    fn end(&self, film: &mut Writer) -> Result<()> {
        let Some(seen) = &self.seen else {
            return Ok(());
        };
        let picture = self.beside_goal(picture::colors(&seen.heightmap));
        film.shoot(&picture, WAITING, END_MS)
    }

    fn beside_goal(&self, workspace: RgbImage) -> RgbImage {
        let goal = self.goal.as_ref().map(|goal| Arc::clone(&goal.image));
        let goal = match &goal {
            Some(goal) => picture::colors(goal),
            None => RgbImage::new(workspace.width(), workspace.height()),
        };
        picture::side_by_side(&[workspace, goal])
    }
}

/// Writes frames.
struct Writer {
    encoder: GifEncoder<BufWriter<File>>,
    frames: usize,
}

impl Writer {
    fn create(path: &Path) -> Result<Self> {
        let file = File::create(path).with_context(|| path.display().to_string())?;
        let mut encoder = GifEncoder::new_with_speed(BufWriter::new(file), 10);
        encoder.set_repeat(Repeat::Infinite)?;
        Ok(Self { encoder, frames: 0 })
    }

    fn shoot(&mut self, picture: &RgbImage, border: Rgb<u8>, shown_ms: u32) -> Result<()> {
        // Nearest neighbours: no new colours, so that the palette of a frame holds them all.
        let (width, height) = (picture.width() / 2, picture.height() / 2);
        let scaled = imageops::resize(picture, width, height, FilterType::Nearest);
        let around = 2 * BORDER_PX;
        let mut framed = RgbImage::from_pixel(width + around, height + around, border);
        imageops::replace(&mut framed, &scaled, BORDER_PX.into(), BORDER_PX.into());
        let image = DynamicImage::ImageRgb8(framed).into_rgba8();
        let delay = Delay::from_numer_denom_ms(shown_ms, 1);
        self.encoder
            .encode_frame(Frame::from_parts(image, 0, 0, delay))?;
        self.frames += 1;
        Ok(())
    }
}
