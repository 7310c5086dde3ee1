// SPDX-License-Identifier: Apache-2.0
#include "fuzz.h"
#include "omnister/calibration/rig_file.h"

void omnister::fuzz::fuzzOne(std::string_view bytes) {
  takes([&] {
    const RigFile rig = parseRigFile(bytes, "input");
    require(rig.T_ref_disp.matrix().allFinite(), "poses are finite");
  });
}
