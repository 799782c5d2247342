// peer DOMAIN SECONDS: says a StepConfirmation on echo/sctn_msgs/StepConfirmation five times a second and ends with 0 when it hears it on
// echoed/sctn_msgs/StepConfirmation. CycloneDDS's own security plugins protect it where CYCLONEDDS_URI asks for them.
#include "dds/dds.h"
#include "step_confirmation.h"
#include <stdio.h>
#include <stdlib.h>

typedef sctn_msgs_msg_dds__StepConfirmation_ StepConfirmation;

static dds_entity_t made(const char *what, dds_entity_t entity) {
  if (entity < 0) {
    fprintf(stderr, "%s: %s\n", what, dds_strretcode(-entity));
    exit(2);
  }
  return entity;
}

int main(int argc, char **argv) {
  if (argc != 3) {
    fprintf(stderr, "peer DOMAIN SECONDS\n");
    return 2;
  }
  dds_entity_t participant = made("participant", dds_create_participant((dds_domainid_t)atoi(argv[1]), NULL, NULL));
  dds_qos_t *qos = dds_create_qos();
  dds_qset_reliability(qos, DDS_RELIABILITY_RELIABLE, DDS_SECS(1));
  dds_qset_history(qos, DDS_HISTORY_KEEP_LAST, 10);
  const dds_topic_descriptor_t *type = &sctn_msgs_msg_dds__StepConfirmation__desc;
  dds_entity_t said = made("topic", dds_create_topic(participant, type, "rt/echo/sctn_msgs/StepConfirmation", qos, NULL));
  dds_entity_t echoed = made("topic", dds_create_topic(participant, type, "rt/echoed/sctn_msgs/StepConfirmation", qos, NULL));
  dds_entity_t writer = made("writer", dds_create_writer(participant, said, qos, NULL));
  dds_entity_t reader = made("reader", dds_create_reader(participant, echoed, qos, NULL));
  StepConfirmation confirmation = {.header.frame_id = "", .proposal_id = 4711, .decision = 1, .operator_name = "a person on CycloneDDS"};
  for (int turn = 0; turn < 5 * atoi(argv[2]); turn++) {
    dds_write(writer, &confirmation);
    dds_sleepfor(DDS_MSECS(200));
    void *sample = NULL;
    dds_sample_info_t info;
    int taken = dds_take(reader, &sample, &info, 1, 1);
    if (taken == 1 && info.valid_data) {
      StepConfirmation *heard = sample;
      printf("%llu %s\n", (unsigned long long)heard->proposal_id, heard->operator_name);
      return 0;
    }
    if (taken > 0) dds_return_loan(reader, &sample, taken);
  }
  return 1;
}
