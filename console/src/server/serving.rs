//! Where the page is served, and with which secrets.

use std::fmt;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;
use tracing::warn;

use super::access::{Access, InvalidToken};
use super::{Page, router};
use crate::listener::{Listener, TlsError, tls_acceptor};

/// Where the page is served, and who may open it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct ServerSettings {
    /// IP address to listen on.
    pub address: String,
    /// TCP port; 0: the system chooses one.
    pub port: u16,
    /// Names by which browsers reach this machine, beside its IP address and localhost; empty ones count as none.
    pub host_names: Vec<String>,
    /// Secret that a browser or program has to show; empty: drawn at start.
    pub token: String,
    /// File that the page's address with the token is written to; empty for none.
    pub address_file: PathBuf,
    /// Certificate and key.
    pub tls: TlsFiles,
}

/// PEM files; both empty: plain HTTP.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TlsFiles {
    /// The certificate chain.
    pub certificate: PathBuf,
    /// Its private key.
    pub key: PathBuf,
}

impl Default for ServerSettings {
    fn default() -> Self {
        Self {
            address: "127.0.0.1".into(),
            port: 8750,
            // A list of ROS parameters must not be empty: its type would be unknown.
            host_names: vec![String::new()],
            token: String::new(),
            address_file: PathBuf::new(),
            tls: TlsFiles::default(),
        }
    }
}

/// Settings that the page is not served with.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InvalidServer {
    /// No IP address.
    #[error("expected an IP address, found {0:?}")]
    Address(String),
    /// One of two files that belong together.
    #[error("expected both certificate and key, or neither")]
    Tls,
    /// Others could read the token on its way.
    #[error("{0} is not a loopback address: it needs tls.certificate and tls.key")]
    NeedsTls(IpAddr),
    /// The token.
    #[error(transparent)]
    Token(#[from] InvalidToken),
}

impl InvalidServer {
    /// The setting that is wrong.
    pub fn setting(&self) -> &'static str {
        match self {
            Self::Address(_) | Self::NeedsTls(_) => "address",
            Self::Tls => "tls",
            Self::Token(_) => "token",
        }
    }
}

impl ServerSettings {
    /// Checks what types cannot express.
    ///
    /// # Errors
    /// Names the setting that the page is not served with.
    pub fn check(&self) -> Result<(), InvalidServer> {
        let ip = self.socket()?.ip();
        if self.has_tls() != (self.tls.key != Path::new("")) {
            return Err(InvalidServer::Tls);
        }
        if !ip.is_loopback() && !self.has_tls() {
            return Err(InvalidServer::NeedsTls(ip));
        }
        Ok(Access::check(&self.token)?)
    }

    fn socket(&self) -> Result<SocketAddr, InvalidServer> {
        let ip = self.address.parse();
        let ip: IpAddr = ip.map_err(|_| InvalidServer::Address(self.address.clone()))?;
        Ok(SocketAddr::new(ip, self.port))
    }

    fn has_tls(&self) -> bool {
        self.tls.certificate != Path::new("")
    }
}

/// What the page is served with: its secrets are read or drawn.
pub struct Server {
    settings: ServerSettings,
    token: String,
    tls: Option<TlsAcceptor>,
}

/// Why nobody can reach the page.
#[derive(Debug, thiserror::Error)]
pub enum ListenError {
    /// The settings.
    #[error(transparent)]
    Settings(#[from] InvalidServer),
    /// The system refuses, for instance because another program listens there.
    #[error("cannot listen on {socket}")]
    Listen {
        /// Where.
        socket: SocketAddr,
        /// The reason.
        source: io::Error,
    },
}

/// A file that cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("{}", path.display())]
pub struct AddressFileError {
    path: PathBuf,
    source: io::Error,
}

impl Server {
    /// Reads certificate and key, and draws a token where none was chosen.
    ///
    /// # Errors
    /// When a file cannot be read, or the key is not that of the certificate.
    pub fn new(settings: ServerSettings) -> Result<Self, TlsError> {
        let TlsFiles { certificate, key } = &settings.tls;
        let tls = match settings.has_tls() {
            true => Some(tls_acceptor(certificate, key)?),
            false => None,
        };
        let token = match settings.token.as_str() {
            "" => crate::secret(),
            token => token.to_owned(),
        };
        Ok(Self {
            settings,
            token,
            tls,
        })
    }

    /// Listens; connections wait until the page is served.
    ///
    /// # Errors
    /// When there is no such address, or it is taken.
    pub async fn listen(&self) -> Result<Listening, ListenError> {
        let socket = self.settings.socket()?;
        let listener = Listener::bind(socket, self.tls.clone())
            .await
            .map_err(|source| ListenError::Listen { socket, source })?;
        let access = Access::new(
            self.token.clone(),
            listener.address(),
            &self.settings.host_names,
            self.tls.is_some(),
        );
        Ok(Listening {
            listener,
            access,
            address_file: self.settings.address_file.clone(),
        })
    }
}

/// A server that listens.
pub struct Listening {
    listener: Listener,
    access: Access,
    address_file: PathBuf,
}

impl fmt::Debug for Listening {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Never the token.
        write!(formatter, "Listening({})", self.access.address())
    }
}

impl Listening {
    /// Where the page is served, without the token: for logs.
    pub fn address(&self) -> String {
        self.access.address()
    }

    /// Writes the page's address with the token to the file that was asked for; returns it where none was, to be shown to the person who
    /// has started the program.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn announce(&self) -> Result<Option<String>, AddressFileError> {
        let path = &self.address_file;
        if path == Path::new("") {
            return Ok(Some(self.access.page()));
        }
        let written = self.access.write_page(path);
        written.map_err(|source| AddressFileError {
            path: path.clone(),
            source,
        })?;
        Ok(None)
    }

    /// Serves the page on a task of its own until `end`.
    pub fn serve(self, page: Page, end: &CancellationToken) {
        let router = router(page, self.access, end.clone());
        let ended = end.clone().cancelled_owned();
        tokio::spawn(async move {
            let served = axum::serve(self.listener, router).with_graceful_shutdown(ended);
            if let Err(error) = served.await {
                warn!("the page is no longer served: {error}");
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::tests::page;
    use crate::state::tests::proposed;
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    use tokio::net::TcpStream;

    #[test]
    fn another_address_than_loopback_needs_tls() {
        let mut settings = ServerSettings {
            address: "0.0.0.0".into(),
            ..Default::default()
        };
        let refused = InvalidServer::NeedsTls([0, 0, 0, 0].into());
        assert_eq!(settings.check(), Err(refused));
        settings.tls = TlsFiles {
            certificate: "certificate.pem".into(),
            key: "key.pem".into(),
        };
        assert_eq!(settings.check(), Ok(()));
        settings.tls.key = PathBuf::new();
        assert_eq!(settings.check(), Err(InvalidServer::Tls));
    }

    #[test]
    fn what_is_no_address_and_a_token_that_can_be_guessed_are_refused_by_their_setting() {
        let of = |address: &str, token: &str| {
            let settings = ServerSettings {
                address: address.into(),
                token: token.into(),
                ..Default::default()
            };
            settings.check().map_err(|invalid| invalid.setting())
        };
        assert_eq!(of("localhost", ""), Err("address"));
        assert_eq!(of("::1", "secret"), Err("token"));
        assert_eq!(of("::1", ""), Ok(()));
    }

    #[tokio::test]
    async fn the_page_is_served_where_the_file_says_until_the_end() {
        let folder = tempfile::tempdir().unwrap();
        let settings = ServerSettings {
            port: 0,
            address_file: folder.path().join("address"),
            ..Default::default()
        };
        let listening = Server::new(settings.clone()).unwrap().listen().await;
        let listening = listening.unwrap();
        assert_eq!(listening.announce().unwrap(), None);
        let address = listening.address();
        let text = std::fs::read_to_string(&settings.address_file).unwrap();
        assert!(text.starts_with(&format!("{address}#token=")), "{text}");
        assert!(!format!("{listening:?}").contains("token"));
        let socket = listening.access.socket();
        let end = CancellationToken::new();
        listening.serve(page(proposed().0, folder.path()), &end);
        let mut stream = TcpStream::connect(socket).await.unwrap();
        let request = format!("GET / HTTP/1.1\r\nHost: {socket}\r\nConnection: close\r\n\r\n");
        stream.write_all(request.as_bytes()).await.unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).await.unwrap();
        assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
        end.cancel();
    }

    #[tokio::test]
    async fn an_address_that_is_taken_and_a_file_that_cannot_be_written_are_named() {
        let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let socket = taken.local_addr().unwrap();
        let mut settings = ServerSettings {
            port: socket.port(),
            ..Default::default()
        };
        let error = Server::new(settings.clone()).unwrap().listen().await;
        let error = error.unwrap_err().to_string();
        assert_eq!(error, format!("cannot listen on {socket}"));
        settings.port = 0;
        let printed = Server::new(settings.clone())
            .unwrap()
            .listen()
            .await
            .unwrap();
        assert!(printed.announce().unwrap().unwrap().contains("#token="));
        settings.address_file = "no/such/folder/address".into();
        let listening = Server::new(settings).unwrap().listen().await.unwrap();
        let error = listening.announce().unwrap_err().to_string();
        assert_eq!(error, "no/such/folder/address");
    }
}
