use bytes::Bytes;
use der::pem;
use ring::{
  rand::SystemRandom,
  signature::{EcdsaKeyPair, KeyPair, ECDSA_P256_SHA256_ASN1_SIGNING},
};

use crate::security::{
  config::{parse_config_error, to_config_error_parse, ConfigError},
  types::SecurityResult,
};

/// The private key of a Certificate (see neghbouring module): PKCS #8, not
/// encrypted.
#[derive(Debug)]
pub(crate) struct PrivateKey {
  key_pair: EcdsaKeyPair,
  random: SystemRandom,
}

impl PrivateKey {
  pub fn from_pem(pem_data: impl AsRef<[u8]>) -> Result<Self, ConfigError> {
    let (label, der) = pem::decode_vec(pem_data.as_ref())
      .map_err(to_config_error_parse("Cannot read the PEM of a private key"))?;
    if label != "PRIVATE KEY" {
      return Err(parse_config_error(format!(
        "Expected PEM of a PRIVATE KEY (PKCS #8, not encrypted), found {label}"
      )));
    }
    let random = SystemRandom::new();
    let key_pair = EcdsaKeyPair::from_pkcs8(&ECDSA_P256_SHA256_ASN1_SIGNING, &der, &random)
      .map_err(|e| {
        parse_config_error(format!("Expected an ECDSA key over P-256 (prime256v1): {e}"))
      })?;
    Ok(Self { key_pair, random })
  }

  pub fn public_key(&self) -> &[u8] {
    self.key_pair.public_key().as_ref()
  }

  pub fn sign(&self, msg: &[u8]) -> SecurityResult<Bytes> {
    let signature = self.key_pair.sign(&self.random, msg)?;
    Ok(Bytes::copy_from_slice(signature.as_ref()))
  }
}

#[cfg(test)]
mod tests {
  use super::*;

  #[test]
  pub fn parse_private_key() {
    let priv_key_pem = r#"-----BEGIN PRIVATE KEY-----
MIGHAgEAMBMGByqGSM49AgEGCCqGSM49AwEHBG0wawIBAQQgaPBddesE0rHiP5/c
+djUjctfNoMAa5tNxOdged9AQtOhRANCAATKbyUP/dWap5kUbXky9qmhBc9ne0hg
EEJPTyIYWQldbZS8GH/4SOMViyWhL/BcSU48V0RidVPvyKqqiLyVaVmk
-----END PRIVATE KEY-----
"#;

    PrivateKey::from_pem(priv_key_pem).unwrap();
  }
}
