// SPDX-License-Identifier: Apache-2.0
#include <cmath>

#include "device/stage/grbl/grbl_protocol.h"
#include "device/stage/zaber/zaber_protocol.h"
#include "fuzz.h"

void omnister::fuzz::fuzzOne(std::string_view bytes) {
  using namespace omnister::device;
  if (const auto reply = parseZaberReply(bytes)) {
    require(reply->warning.size() == 2, "a warning has two characters");
    require(!reply->id || (*reply->id >= 0 && *reply->id <= 99), "message ids have two digits");
  }
  isZaberNotice(bytes);
  if (const auto status = parseGrblStatus(bytes)) {
    require(!status->state.empty(), "a report has a state");
    for (const auto& position : {status->machine, status->work, status->offset})
      for (int axis = 0; position && axis < 3; ++axis)
        require(std::isfinite((*position)[axis]), "positions are finite");
  }
  for (const char* prefix : {"ALARM:", "error:"}) {
    const auto code = parseGrblCode(bytes, prefix);
    require(!code || *code >= 0, "codes are not negative");
  }
}
