//! `sctn console`: the operator's page for a graph that runs.

use crate::root::Root;
use anyhow::{Context as _, Result};
use clap::Args;
use node_kit::{Context, RosArguments, wait_for_end};

/// Arguments of `sctn console`.
#[derive(Args)]
pub struct ConsoleCommand {
    /// IP address to serve the page on; another than a loopback address needs --certificate and --key
    #[arg(long)]
    address: Option<String>,
    /// Port to serve the page on; 0: the system chooses
    #[arg(long)]
    port: Option<u16>,
    /// PEM file of the certificate chain
    #[arg(long, requires = "key")]
    certificate: Option<String>,
    /// PEM file of the private key
    #[arg(long, requires = "certificate")]
    key: Option<String>,
    /// The graph's time is that of /clock: a simulated cell
    #[arg(long)]
    use_sim_time: bool,
    /// ROS arguments: -r __ns:=/cell, -p NAME:=VALUE
    #[arg(last = true)]
    ros: Vec<String>,
}

impl ConsoleCommand {
    pub fn run(self, root: &Root) -> Result<()> {
        let file = root.join("config/operator_console.yaml");
        let enclave = ["--enclave", "/sctn/operator_console"].map(str::to_owned);
        let mut words = vec!["--ros-args".to_owned(), "--params-file".into()];
        words.push(file.display().to_string());
        let given = [
            ("address", self.address),
            ("port", self.port.map(|port| port.to_string())),
            ("tls.certificate", self.certificate),
            ("tls.key", self.key),
            ("use_sim_time", Some(self.use_sim_time.to_string())),
        ];
        for (name, value) in given {
            if let Some(value) = value {
                words.extend(["-p".to_owned(), format!("{name}:={value}")]);
            }
        }
        words.extend(enclave.into_iter().chain(self.ros));
        let (arguments, _) = RosArguments::parse(words)?;
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .enable_all()
            .build()
            .context("tokio runtime")?;
        runtime.block_on(async {
            let context = Context::from_environment()?;
            let mut node = operator_console::start(&context, &arguments)?;
            tokio::select! {
                ended = &mut node => ended.context("the console panicked")?,
                signal = wait_for_end() => {
                    signal?;
                    context.shutdown();
                    node.await.context("the console panicked")?
                }
            }
        })
    }
}
